"""Base of the formats that are MCAP files."""

from collections.abc import Mapping
from typing import ClassVar, Final

from mcap.writer import CompressionType, Writer

from resonator_daemon.board.recording.mcap_messages import CHUNK_BYTES
from resonator_daemon.tools.export.output import Output

METADATA: Final = "resonatord"


class McapOutput(Output):
    """One MCAP file.

    Attributes
    ----------
    profile, schema_encoding, message_encoding : str
        As MCAP names them.
    channel_metadata : dict
        Metadata of each channel.
    prefix : str
        Left out of the names of channels in `rows`.
    """

    profile: ClassVar[str] = ""
    schema_encoding: ClassVar[str]
    message_encoding: ClassVar[str]
    channel_metadata: ClassVar[Mapping[str, str]] = {}
    prefix = ""

    def begin(self) -> None:
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._writer = Writer(self._new_file().file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(self.profile, METADATA)
        self._writer.add_metadata(METADATA, dict(self._recorded.metadata))

    def write(self, channel: str, schema: str, definition: str, data: bytes, log_ns: int, publish_ns: int) -> None:
        """Write one message; `definition` is the text of its schema, used the first time."""
        if channel not in self._channels:
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(schema, self.schema_encoding, definition.encode())
            self._channels[channel] = self._writer.register_channel(
                channel, self.message_encoding, self._schemas[schema], dict(self.channel_metadata)
            )
        self._writer.add_message(self._channels[channel], log_ns, data, publish_ns)
        self.rows[channel.removeprefix(self.prefix)] += 1

    def finish(self) -> None:
        self._writer.finish()
