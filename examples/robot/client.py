"""A robot program in twenty lines and nothing but the standard library: docs/robot.md, mode request.

python examples/robot/client.py [--accept-replay]
"""

import json
import socket
import sys
import time

with socket.create_connection(("127.0.0.1", 5005), timeout=3) as sock, sock.makefile("rw") as line:
    ids = iter(range(1, 1 << 53))

    def ask(op, **fields):  # noqa: ANN001, ANN003, ANN201
        """Send a request; return its answer and the moment it was asked."""
        asked, number = time.monotonic(), next(ids)
        line.write(json.dumps({"op": op, "id": number, **fields}) + "\n")
        line.flush()
        while (answer := json.loads(line.readline())).get("id") != number:
            pass  # a heartbeat
        return answer, asked

    replay = "--accept-replay" in sys.argv
    hello = {"op": "hello", "version": "1.0", "mode": "request", "accept_replay": replay}
    line.write(json.dumps(hello) + "\n")
    for _ in range(10):
        answer, asked = ask("get_targets", max=1)
        for target in answer.get("targets", []):  # none: the bed is empty, or `stale`
            accepted, _ = ask("ack", target=target["id"], result="accepted")
            fresh = (time.monotonic() - asked) * 1000 < answer["valid_ms"]
            if accepted["op"] == "acked":
                sys.stdout.write(f"{target['id']} at {target['position']}\n")  # move here, if fresh
                ask("ack", target=target["id"], result="done" if fresh else "failed")
        time.sleep(0.1)
