"""A recording as an MCAP file that `ros2 bag` and viewers of ROS read: messages in CDR; no ROS is needed."""

from types import MappingProxyType
from typing import Any

from resonator_daemon.extensions.viewer_support import Geometry, McapOutput
from resonator_daemon.mqtt.topics import Topic


class Format(McapOutput):
    """Messages as the bridge to ROS publishes them; the file has the definitions of their types."""

    profile = "ros2"
    schema_encoding = "ros2msg"
    message_encoding = "cdr"
    channel_metadata = MappingProxyType({"offered_qos_profiles": ""})

    def begin(self) -> None:
        from resonator_daemon.extensions.ros2.messages import Translation  # needs a library that may be missing

        super().begin()
        self._translation = Translation(self._recorded.name, Geometry.of_plate(self._recorded.plate))
        self.prefix = f"/{self._translation.frame_id}/"

    def put(self, topic: Topic[Any], message: Any, now_ns: int) -> None:
        for one in self._translation.messages(topic.path, message):
            known = one.kind in self._schemas
            definition = "" if known else self._translation.store.generate_msgdef(one.kind, ros_version=2)[0]
            self.write(one.topic, one.kind, definition, self._translation.encode(one), now_ns, message.t_ns)
