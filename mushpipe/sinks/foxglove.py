"""Sink `foxglove`: a live run in the Foxglove app, over the WebSocket server of its SDK."""

from __future__ import annotations

import logging
from typing import Any, ClassVar, Literal

from pydantic import Field, PrivateAttr

from mushpipe import RunInfo, Sink, Trace
from mushpipe.core import wire
from mushpipe.core.errors import UsageError
from mushpipe.core.transform import Transform, base_of
from mushpipe.sinks.messages import Published, base_message, result_messages, timing_message

logger = logging.getLogger("mushpipe")


class FoxgloveSink(Sink):
    """Serves frames and results to the Foxglove app, which connects to ws://127.0.0.1:8765.

    The topics and messages are those of the sink `mcap`; graphs/foxglove-layout.json arranges them.
    """

    delivery: ClassVar[Literal["every", "latest"]] = "latest"

    port: int = Field(8765, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    host: str = Field("127.0.0.1", description="address to listen on; 0.0.0.0 lets everybody in")
    jpeg_quality: int = Field(80, ge=1, le=100, description="quality of the colour images sent")

    _server: Any = PrivateAttr(None)
    _context: Any = PrivateAttr(None)
    _channels: dict[tuple[str, str], Any] = PrivateAttr(default_factory=dict)
    _unknown: set[type] = PrivateAttr(default_factory=set)
    _base: Transform | None = PrivateAttr(None)

    def open(self, run: RunInfo) -> None:
        """Start the server.

        Raises:
            UsageError: The port is taken, or the address is not one of this machine.
        """
        import foxglove

        self._context = foxglove.Context()
        self._base = base_of(run.manifest.get("graph", {}))
        try:
            self._server = foxglove.start_server(
                name=f"mushpipe {run.recording}",
                host=self.host,
                port=self.port,
                context=self._context,
            )
        except (RuntimeError, OSError) as error:
            text = f"{self.host}:{self.port} cannot be served: {error}; set another host or port"
            raise UsageError(f"{text}, or end the program that has this one") from error
        address = f"ws://{self.host}:{self._server.port}"
        logger.info("Foxglove: open connection, Foxglove WebSocket, %s", address)

    def consume(self, trace: Trace) -> None:
        """Send one frame to who is connected; where nobody is, this costs nothing.

        The first frame is made for nobody all the same: it tells the topics there are.
        """
        if self._channels and not any(channel.has_sinks() for channel in self._channels.values()):
            return
        frame = trace.frame
        color = wire.encode_color(frame, self.jpeg_quality)
        self._send(trace, (wire.COLOR_TOPIC, color))
        if frame.depth is not None:
            self._send(trace, (wire.DEPTH_TOPIC, wire.encode_depth(frame)))
        if frame.camera is not None:
            message = wire.encode_camera(frame.camera, frame.color.shape, frame.header)
            self._send(trace, (wire.CAMERA_TOPIC, message))
        for published in result_messages(trace, self._unknown, drawn=True):
            self._send(trace, published)
        if self._base is not None:
            self._send(trace, base_message(self._base, frame.header))
        self._send(trace, timing_message(trace))

    def _send(self, trace: Trace, published: Published) -> None:
        topic, message = published
        key = (topic, message.schema.name)
        if key not in self._channels:
            self._channels[key] = self._channel(topic, message)
        self._channels[key].log(message.data, log_time=trace.frame.header.stamp_ns)

    def _channel(self, topic: str, message: wire.Message) -> Any:
        import foxglove

        schema = message.schema
        return foxglove.Channel(
            topic,
            schema=foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data),
            message_encoding=schema.message_encoding,
            context=self._context,
            metadata=dict(message.metadata),
        )

    def close(self) -> None:
        """Stop the server."""
        for channel in self._channels.values():
            channel.close()
        self._channels.clear()
        if self._server is not None:
            self._server.stop()
            self._server = None
