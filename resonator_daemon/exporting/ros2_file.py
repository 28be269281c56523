"""A recording as an MCAP file that `ros2 bag` and viewers of ROS read: messages in CDR, with their definitions."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from resonator_daemon.exporting.mcap_file import begun_writer
from resonator_daemon.exporting.ros2_messages import RosMessages, ros_name
from resonator_daemon.host.new_file import NewFile
from resonator_daemon.plate import Plate
from resonator_daemon.replay.recorded_pipeline import Moment


class Ros2Output:
    """Writes what ROS has kinds of messages for, under `/NAME/...`, and contacts in a kind that comes with the file.

    Parameters
    ----------
    path
        Of the file.
    topics
        Paths of those to be exported.
    plate
        Of the recording.
    name
        Of the plate.
    metadata
        Of the file.
    """

    def __init__(self, path: Path, topics: Sequence[str], plate: Plate, name: str, metadata: Mapping[str, str]) -> None:
        self._name = ros_name(name)
        self._messages = RosMessages(plate, self._name)
        self._topics = frozenset(topics)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.rows: dict[str, int] = {}
        self._new = NewFile(path)
        self._writer = begun_writer(self._new, "ros2", metadata)

    def take(self, moment: Moment) -> None:
        for topic, message in moment.messages:
            if topic.path not in self._topics:
                continue
            for made in self._messages.of(topic, message):
                channel = self._channel(f"/{self._name}/{made.path}", made.kind)
                self._writer.add_message(channel, moment.now.utc_ns, self._messages.encode(made), made.t_ns)
                self.rows[made.path] = self.rows.get(made.path, 0) + 1

    def close(self) -> Mapping[str, int]:
        self._writer.finish()
        return {str(self._new.path): self._new.keep()}

    def discard(self) -> None:
        self._new.discard()

    def _channel(self, topic: str, kind: str) -> int:
        if kind not in self._schemas:
            definition = self._messages.definition(kind).encode()
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition)
        if topic not in self._channels:
            metadata = {"offered_qos_profiles": ""}
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind], metadata)
        return self._channels[topic]
