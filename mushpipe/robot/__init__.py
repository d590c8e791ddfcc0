"""The robot socket: what a machine may act on, and nothing else.

The protocol is written down in docs/robot.md. `server` and `connection`, `client` and `replay`
touch a socket; `hub`, `session` and `abb` are state machines that are handed lines and a clock.
"""
