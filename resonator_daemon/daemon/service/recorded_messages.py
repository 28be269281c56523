"""What is published, handed to a recording as JSON channels next to the bytes of the link."""

from collections.abc import Callable
from typing import Any

from resonator_daemon.board.recording.writer import Published
from resonator_daemon.mqtt.codec import encode
from resonator_daemon.mqtt.topics import JSON, Topic


class RecordedMessages:
    """Records published messages; never waits.

    States and descriptions, which are retained, are always recorded; what is measured where it is wanted. Arrays are
    not: they have ten times the size of the bytes that they come from.

    Parameters
    ----------
    publish
        Receives the messages: that of a recorder, or of a switch before one.
    include_messages
        Whether to record what is measured.
    """

    def __init__(self, publish: Callable[[Published], None], *, include_messages: bool) -> None:
        self._publish = publish
        self._schemas: dict[str, dict[str, Any]] = {}
        self.include_messages = include_messages

    def record(self, topic: Topic[Any], message: Any) -> None:
        """Record a message if its topic is to be recorded."""
        if not (topic.retained or self.include_messages) or topic.content_type != JSON:
            return
        if topic.path not in self._schemas:
            self._schemas[topic.path] = topic.payload.model_json_schema(mode="serialization")
        schema = self._schemas[topic.path]
        self._publish(Published(topic.path, message.t_ns, encode(message), schema, topic.retained))
