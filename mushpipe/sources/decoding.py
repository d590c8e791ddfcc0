"""Recorded messages to objects with the fields that their schemas name."""

from __future__ import annotations

from typing import Any

from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as Ros2Decoders

from mushpipe.core.recording import CONVERT, ZSTD, Raw
from mushpipe.sources.images import with_ros2_names

_COMPRESSED = (
    "each message is compressed (ros2 bag record --compression-mode message): "
    f"{CONVERT.format('ITS_FOLDER')} unpacks them"
)


class Decoder:
    """Decodes the messages of one file or stream, whose schemas it remembers."""

    def __init__(self) -> None:
        self._factories = (ProtobufDecoders(), Ros2Decoders())

    def decode(self, raw: Raw) -> Any:
        """Return a message.

        Raises:
            ValueError: It is of an encoding that is not known, compressed, or without its schema.
            Exception: Whatever a decoder makes of foreign bytes.
        """
        if raw.message.data.startswith(ZSTD):  # no message begins so, CDR begins with 0
            raise ValueError(_COMPRESSED)
        if raw.schema and not raw.schema.data:  # it would be decoded to nothing
            raise ValueError(f"the file lacks the definition of {raw.schema.name}")
        schema = with_ros2_names(raw.schema)
        for factory in self._factories:
            decoder = factory.decoder_for(raw.channel.message_encoding, schema)
            if decoder is not None:
                return decoder(raw.message.data)
        raise ValueError(
            f"message encoding '{raw.channel.message_encoding}' with schema encoding "
            f"'{schema.encoding if schema else ''}' is not supported (supported: cdr with "
            "ros2msg, protobuf with protobuf)"
        )
