"""What is published, handed to a recording as JSON channels beside the bytes of the link."""

from collections.abc import Mapping
from typing import Any, Protocol

from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.topics import JSON, Topic


class Channels(Protocol):
    """What takes the messages: a recorder, or a switch before one."""

    def put_message(self, topic_path: str, t_ns: int, payload: bytes, json_schema: Mapping[str, Any]) -> None: ...

    def put_state(self, topic_path: str, t_ns: int, payload: bytes, json_schema: Mapping[str, Any]) -> None: ...


class RecordedMessages:
    """Records published messages; never waits.

    States and descriptions, which are retained, are always recorded; what is measured where it is wanted. Arrays are
    not: they have ten times the size of the bytes that they come from.

    Parameters
    ----------
    channels
        Take the messages.
    derived
        Whether to record what is measured.
    """

    def __init__(self, channels: Channels, *, derived: bool) -> None:
        self._channels = channels
        self._schemas: dict[str, dict[str, Any]] = {}
        self.derived = derived

    def record(self, topic: Topic[Any], message: Any) -> None:
        """Record a message if its topic is to be recorded."""
        if topic.content_type != JSON or not (topic.retained or self.derived):
            return
        if topic.path not in self._schemas:
            self._schemas[topic.path] = topic.payload.model_json_schema(mode="serialization")
        put = self._channels.put_state if topic.retained else self._channels.put_message
        put(topic.path, message.t_ns, encode(message), self._schemas[topic.path])
