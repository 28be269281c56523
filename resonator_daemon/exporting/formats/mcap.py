"""A recording as an MCAP file for viewers: each message as JSON with its schema, clouds of points, and a log."""

import base64
import json
from collections.abc import Mapping
from functools import cache
from typing import Any, Final

from resonator_daemon.config.text import plate_text, settings_text
from resonator_daemon.exporting.clouds import Clouds, Points
from resonator_daemon.exporting.mcap_output import McapOutput, cloud_fields, severity, state_text
from resonator_daemon.exporting.tables import WITH_TABLE
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.payloads import WITH_ARRAYS, Header, Message, State
from resonator_daemon.publishing.topics import INFO, TOPICS, Topic
from resonator_daemon.recording.reader import (
    INFO_LEVEL,
    MARK_SCHEMA_DATA,
    MARKS,
    PLATE_FILE,
    SETTINGS_FILE,
    TIME_SCHEMA,
    Mark,
    encode_mark,
    json_time,
    log_line,
)
from resonator_daemon.replay.recorded_pipeline import Moment

_LOG: Final = "log"
_NUMBER: Final = {"type": "number"}
_VECTOR: Final = {"type": "object", "properties": dict.fromkeys("xyz", _NUMBER)}
_QUATERNION: Final = {"type": "object", "properties": dict.fromkeys("xyzw", _NUMBER)}
_FIELD: Final = {
    "type": "object",
    "properties": {"name": {"type": "string"}, "offset": {"type": "integer"}, "type": {"type": "integer"}},
}
# As MARK_SCHEMA, one that viewers recognise by its title.
_CLOUD_SCHEMA: Final = {
    "title": "foxglove.PointCloud",
    "type": "object",
    "properties": {
        "timestamp": TIME_SCHEMA,
        "frame_id": {"type": "string"},
        "pose": {"type": "object", "properties": {"position": _VECTOR, "orientation": _QUATERNION}},
        "point_stride": {"type": "integer"},
        "fields": {"type": "array", "items": _FIELD},
        "data": {"type": "string", "contentEncoding": "base64"},
    },
}
_NUMERIC_TYPES: Final = {"<u2": 3, "<f4": 7, "<f8": 8}  # UINT16, FLOAT32, FLOAT64
_POSE: Final = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


class Format(McapOutput):
    """Messages as they were published, those with arrays as clouds alone, at the time when they were."""

    available = (*WITH_TABLE, INFO.path)
    schema_encoding = "jsonschema"
    message_encoding = "json"

    def begin(self) -> None:
        super().begin()
        config = self._recorded.config
        for name, text in ((PLATE_FILE, plate_text(config.plate)), (SETTINGS_FILE, settings_text(config))):
            self._writer.add_attachment(0, 0, name, "application/toml", text.encode())
        self._clouds = Clouds(config.plate.site_ids, config.plate.site_positions_m)

    def add(self, moment: Moment) -> None:
        if moment.mark is not None:
            now_ns = moment.now.utc_ns
            self._put_json(MARKS, MARK_SCHEMA_DATA, encode_mark(Mark(moment.now, moment.mark)), now_ns, now_ns)
        super().add(moment)

    def put(self, topic: Topic[Any], message: Message, now_ns: int) -> None:
        path, t_ns = topic.path, message.t_ns if isinstance(message, Header) else now_ns
        if not isinstance(message, WITH_ARRAYS):
            self._put_json(path, _schema_of(path), encode(message), now_ns, t_ns)
        if (points := self._clouds.points(message)) is not None:
            cloud = _cloud(points, self._recorded.name, t_ns)
            self._put_json(f"{path}/cloud", _CLOUD_SCHEMA, cloud, now_ns, t_ns)
        if isinstance(message, State):
            line = log_line(t_ns, INFO_LEVEL + severity(message.state), path, state_text(message))
            self._put_json(_LOG, MARK_SCHEMA_DATA, line, now_ns, t_ns)

    def _put_json(self, channel: str, schema: Mapping[str, Any], data: bytes, now_ns: int, t_ns: int) -> None:
        definition = "" if channel in self._channels else json.dumps(schema)
        self.write(channel, schema["title"], definition, data, now_ns, t_ns)


@cache
def _schema_of(path: str) -> dict[str, Any]:
    return TOPICS[path].payload.model_json_schema(mode="serialization")


def _cloud(points: Points, frame_id: str, t_ns: int) -> bytes:
    return json.dumps(
        {
            "timestamp": json_time(t_ns),
            "frame_id": frame_id,
            "pose": _POSE,
            "point_stride": points.dtype.itemsize,
            "fields": cloud_fields(points, _NUMERIC_TYPES, "type"),
            "data": base64.b64encode(points.tobytes()).decode(),
        }
    ).encode()
