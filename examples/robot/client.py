"""A robot program that needs nothing but the standard library: docs/robot.md, mode request."""

import argparse
import json
import socket
import sys
import time
from typing import Any

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("port", metavar="PORT", nargs="?", type=int, default=5005)
server = ("127.0.0.1", parser.parse_args().port)
with socket.create_connection(server, timeout=3) as sock, sock.makefile("rw") as line:
    numbers = iter(range(1, 1 << 53))

    def ask(op: str, **fields: Any) -> dict[str, Any]:
        """Send a request and return its answer."""
        number = next(numbers)
        line.write(json.dumps({"op": op, "id": number, **fields}) + "\n")
        line.flush()
        answer: dict[str, Any] = {}
        while answer.get("id") != number:  # a heartbeat has none
            answer = json.loads(line.readline())
        return answer

    # A machine in production does not accept_replay.
    hello = {"op": "hello", "version": "1.0", "mode": "request", "accept_replay": True}
    line.write(json.dumps(hello) + "\n")
    for _ in range(10):
        asked = time.monotonic()
        answer = ask("get_targets", max=1)
        for target in answer.get("targets", []):  # none: the bed is empty, or it is `stale`
            if ask("ack", target=target["id"], result="accepted")["op"] == "acked":
                fresh = 1000 * (time.monotonic() - asked) < answer["valid_ms"]
                if fresh:  # only now may it move
                    sys.stdout.write(f"{target['id']} at {target['position']}\n")
                ask("ack", target=target["id"], result="done" if fresh else "failed")
        time.sleep(0.1)
