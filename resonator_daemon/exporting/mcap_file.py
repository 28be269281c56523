"""A recording as an MCAP file for viewers: each message as JSON with its schema, clouds of points, and a log."""

import base64
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

from mcap.writer import CompressionType, Writer

from resonator_daemon.exporting.clouds import WITH_CLOUD, Clouds, Points
from resonator_daemon.exporting.severity import Severity, severity
from resonator_daemon.host.new_file import NewFile
from resonator_daemon.plate import Plate
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.payloads import WITH_ARRAYS, Header, Message, State
from resonator_daemon.publishing.topics import TOPICS, Topic
from resonator_daemon.recording.mcap_messages import CHUNK_BYTES
from resonator_daemon.recording.reader import MARK_SCHEMA_DATA, MARKS
from resonator_daemon.replay.recorded_pipeline import Moment

METADATA: Final = "resonatord"

_LOG: Final = "log"
_TIME: Final = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_NUMBER: Final = {"type": "number"}
_VECTOR: Final = {"type": "object", "properties": dict.fromkeys("xyz", _NUMBER)}
_QUATERNION: Final = {"type": "object", "properties": dict.fromkeys("xyzw", _NUMBER)}
_FIELD: Final = {
    "type": "object",
    "properties": {"name": {"type": "string"}, "offset": {"type": "integer"}, "type": {"type": "integer"}},
}
# As MARK_SCHEMA, one that viewers know by its title.
CLOUD_SCHEMA: Final = {
    "title": "foxglove.PointCloud",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "pose": {"type": "object", "properties": {"position": _VECTOR, "orientation": _QUATERNION}},
        "point_stride": {"type": "integer"},
        "fields": {"type": "array", "items": _FIELD},
        "data": {"type": "string", "contentEncoding": "base64"},
    },
}
_NUMERIC_TYPES: Final = {"<u2": 3, "<f4": 7, "<f8": 8}  # UINT16, FLOAT32, FLOAT64
_POSE: Final = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
_LEVELS: Final = {Severity.OK: 2, Severity.WARN: 3, Severity.ERROR: 4}  # of the log


class McapOutput:
    """Writes messages as they were published, those with arrays as clouds alone, at the time when they were.

    Parameters
    ----------
    path
        Of the file.
    topics
        Paths of those to be exported.
    plate
        Of the recording.
    frame_id
        Names the plate's coordinates.
    metadata
        Of the file.
    attachments
        Texts by name.
    """

    def __init__(
        self,
        path: Path,
        topics: Sequence[str],
        plate: Plate,
        frame_id: str,
        metadata: Mapping[str, str],
        attachments: Mapping[str, str],
    ) -> None:
        self._new = NewFile(path)
        self._topics = frozenset(topics)
        self._clouds = Clouds(plate)
        self._frame_id = frame_id
        self._channels: dict[str, int] = {}
        self.rows: dict[str, int] = {}
        self._writer = begun_writer(self._new, "", metadata, attachments)

    def take(self, moment: Moment) -> None:
        now_ns = moment.now.utc_ns
        if moment.mark is not None:
            self._add(MARKS, MARK_SCHEMA_DATA, _log_line(now_ns, Severity.OK, "mark", moment.mark), now_ns, now_ns)
        for topic, message in moment.messages:
            if topic.path in self._topics:
                self._put(topic, message, now_ns)

    def close(self) -> Mapping[str, int]:
        self._writer.finish()
        return {str(self._new.path): self._new.keep()}

    def discard(self) -> None:
        self._new.discard()

    def _put(self, topic: Topic[Any], message: Message, now_ns: int) -> None:
        path, t_ns = topic.path, message.t_ns if isinstance(message, Header) else now_ns
        if not isinstance(message, WITH_ARRAYS):
            self._add(path, _schema_of(topic.path), encode(message), now_ns, t_ns)
        if path in WITH_CLOUD:
            points = self._clouds.points(message)
            if points is not None:
                self._add(f"{path}/cloud", CLOUD_SCHEMA, _cloud(points, self._frame_id, t_ns), now_ns, t_ns)
        if isinstance(message, State):
            text = f"{message.state}: {message.reason}" if message.reason else str(message.state)
            self._add(_LOG, MARK_SCHEMA_DATA, _log_line(t_ns, severity(message.state), path, text), now_ns, t_ns)

    def _add(self, channel: str, schema: Mapping[str, Any], data: bytes, log_ns: int, publish_ns: int) -> None:
        if channel not in self._channels:
            schema_id = self._writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            self._channels[channel] = self._writer.register_channel(channel, "json", schema_id)
        self._writer.add_message(self._channels[channel], log_ns, data, publish_ns)
        self.rows[channel] = self.rows.get(channel, 0) + 1


def begun_writer(
    new: NewFile, profile: str, metadata: Mapping[str, str], attachments: Mapping[str, str] | None = None
) -> Writer:
    """Return a writer of a file that has what comes first in it; nothing is left of the file where that fails."""
    try:
        writer = Writer(new.file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        writer.start(profile, METADATA)
        writer.add_metadata(METADATA, dict(metadata))
        for name, text in (attachments or {}).items():
            writer.add_attachment(0, 0, name, "application/toml", text.encode())
    except BaseException:
        new.discard()
        raise
    return writer


@cache
def _schema_of(path: str) -> dict[str, Any]:
    return TOPICS[path].payload.model_json_schema(mode="serialization")


def _time(t_ns: int) -> dict[str, int]:
    sec, nsec = divmod(t_ns, 10**9)
    return {"sec": sec, "nsec": nsec}


def _log_line(t_ns: int, how_bad: Severity, name: str, text: str) -> bytes:
    level = _LEVELS[how_bad]
    line = {"timestamp": _time(t_ns), "level": level, "message": text, "name": name, "file": "", "line": 0}
    return json.dumps(line).encode()


def _cloud(points: Points, frame_id: str, t_ns: int) -> bytes:
    return json.dumps(
        {
            "timestamp": _time(t_ns),
            "frame_id": frame_id,
            "pose": _POSE,
            "point_stride": points.dtype.itemsize,
            "fields": [
                {"name": name, "offset": field[1], "type": _NUMERIC_TYPES[field[0].str]}
                for name, field in (points.dtype.fields or {}).items()
            ],
            "data": base64.b64encode(points.tobytes()).decode(),
        }
    ).encode()
