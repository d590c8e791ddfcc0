MODULE MushroomPicker
    ! RAPID client of the lines for ABB (docs/robot.md), for a graph with
    !   pick:  {use: picks, T_base_camera: {...}}
    !   robot: {use: robot-json, abb_port: 5006, workspace: {...}}
    ! Not run on a controller yet: check it in RobotStudio before you trust it.
    ! T_base_camera must be in the frame of this work object.
    PERS wobjdata wobj_bed := [FALSE, TRUE, "", [[0,0,0],[1,0,0,0]], [[0,0,0],[1,0,0,0]]];
    PERS tooldata tool_cup := [TRUE, [[0,0,120],[1,0,0,0]], [0.5,[0,0,60],[1,0,0,0],0,0,0]];
    CONST num MAX_AGE_MS := 200;
    CONST num VALID_S := 0.5;   ! from the image to the moment of setting off
    VAR socketdev vision;
    VAR bool connected := FALSE;
    VAR string picked := "";   ! what the server has not been told yet
    VAR string session := "";  ! of the server; ids are of one session only

    PROC main()
        WHILE TRUE DO
            IF connected THEN
                PickOne;
            ELSE
                Connect;
            ENDIF
        ENDWHILE
    ERROR
        ! Whatever broke the connection: nothing received before counts any more. The loop connects
        ! again, as often as it takes: RAPID does not recover from errors that occur in here.
        StopMove;
        SocketClose vision;
        connected := FALSE;
        WaitTime 1;
        StartMove;
        TRYNEXT;
    ENDPROC

    PROC Connect()
        VAR string answer;
        VAR string before;
        SocketCreate vision;
        SocketConnect vision, "127.0.0.1", 5006 \Time:=3;
        answer := Ask("HELLO,1,NAME=irb");   ! one name per robot: another robot, another name
        IF StrMatch(answer, 1, "HELLO,1,LIVE,") <> 1 THEN
            TPWrite "vision: " + answer;
            Stop;
        ENDIF
        before := session;
        session := StrPart(answer, 14, StrLen(answer) - 13);
        ! Under the same name this robot still holds what it had accepted. In another session the
        ! server was restarted: that id is another mushroom's now.
        IF picked <> "" AND session = before THEN
            answer := Ask("ACK," + picked + ",DONE");
        ENDIF
        picked := "";
        connected := TRUE;
    ENDPROC

    ! One line out, one line in. The server never speaks unasked.
    FUNC string Ask(string text)
        VAR string answer;
        SocketSend vision \Str:=text + "\0A";
        SocketReceive vision \Str:=answer \Time:=3;
        RETURN StrPart(answer, 1, StrLen(answer) - 1);
    ENDFUNC

    ! Take the next comma-separated field off the line.
    FUNC string Field(INOUT string line)
        VAR num comma;
        VAR string value;
        comma := StrFind(line, 1, ",");
        value := StrPart(line, 1, comma - 1);
        IF comma < StrLen(line) THEN
            line := StrPart(line, comma + 1, StrLen(line) - comma);
        ELSE
            line := "";
        ENDIF
        RETURN value;
    ENDFUNC

    FUNC num Number(INOUT string line)
        VAR num value;
        IF NOT StrToVal(Field(line), value) THEN
            RAISE ERR_ARGVALERR;
        ENDIF
        RETURN value;
    ENDFUNC

    PROC PickOne()
        VAR string line;
        VAR string id;
        VAR pos place;
        VAR orient turn;
        VAR num diameter;
        VAR num flags;
        VAR num age;
        VAR robtarget cap;
        VAR clock asked;
        ClkReset asked;
        ClkStart asked;
        line := Ask("NEXT," + ValToStr(MAX_AGE_MS));
        IF Field(line) <> "T" THEN
            WaitTime 0.2;   ! NONE, or E,STALE,...: there is nothing to do now
            RETURN;
        ENDIF
        id := Field(line);
        place.x := Number(line);
        place.y := Number(line);
        place.z := Number(line);
        turn.q1 := Number(line);
        turn.q2 := Number(line);
        turn.q3 := Number(line);
        turn.q4 := Number(line);
        diameter := Number(line);
        flags := Number(line);
        age := Number(line);
        IF BitAnd(flags, 4) <> 0 THEN
            line := Ask("ACK," + id + ",REJECTED,60000");   ! the orientation is unknown
            RETURN;
        ENDIF
        line := Ask("ACK," + id + ",ACCEPTED");
        IF line <> "A," + id + ",REMOVED" THEN
            RETURN;
        ENDIF
        ! Asked, answered and accepted: all of that took time, and a paused program takes more.
        IF age / 1000 + ClkRead(asked) > VALID_S THEN
            line := Ask("ACK," + id + ",REJECTED");
            RETURN;
        ENDIF
        ! +z of the cap points out of it, the tool's +z into it: half a turn about x.
        cap := CRobT(\Tool:=tool_cup \WObj:=wobj_bed);
        cap.trans := place;
        cap.rot := NOrient(turn) * [0,1,0,0];
        MoveL RelTool(cap, 0, 0, -80), v200, fine, tool_cup \WObj:=wobj_bed;
        MoveL cap, v50, fine, tool_cup \WObj:=wobj_bed;
        ! ... grip and twist ...
        MoveL RelTool(cap, 0, 0, -80), v50, fine, tool_cup \WObj:=wobj_bed;
        ! Where the moves took more than 10 s, the server has hung up, and Connect says it again.
        picked := id;
        line := Ask("ACK," + id + ",DONE");
        picked := "";
    ENDPROC
ENDMODULE
