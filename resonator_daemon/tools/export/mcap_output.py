"""Base of the formats that are MCAP files, and what they show alike: times, states, fields of clouds."""

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from mcap.writer import CompressionType, Writer

from resonator_daemon.board.recording.mcap_messages import CHUNK_BYTES
from resonator_daemon.mqtt.payloads import Condition, State
from resonator_daemon.tools.export.clouds import Points
from resonator_daemon.tools.export.output import Output

METADATA: Final = "resonatord"

OK, WARN, ERROR = range(3)  # as diagnostic_msgs/DiagnosticStatus counts


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


def severity(state: Condition) -> int:
    """Return how bad a state is: an error must be repaired, and a warning may pass."""
    match state:
        case Condition.ONLINE | Condition.STARTING:
            return OK
        case Condition.REFUSED:
            return ERROR
    return WARN


def state_text(message: State) -> str:
    """Return state and reason as one line."""
    return f"{message.state}: {message.reason}" if message.reason else str(message.state)


def cloud_fields(points: Points, types: Mapping[str, int], type_key: str) -> list[dict[str, Any]]:
    """Return name, offset and type of each field of a cloud; `types` has the number of each numpy type."""
    return [
        {"name": name, "offset": field[1], type_key: types[field[0].str]}
        for name, field in (points.dtype.fields or {}).items()
    ]
