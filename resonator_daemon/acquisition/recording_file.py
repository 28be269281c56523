"""The file of a recording: an MCAP container with one message for each event on a link; read in order."""

import hashlib
import json
import logging
import os
import stat
import struct
from collections.abc import Iterator
from types import TracebackType
from typing import IO, Final, NamedTuple, Self

from mcap.exceptions import McapError
from mcap.records import Channel, Header, McapRecord, Message, Metadata
from mcap.stream_reader import StreamReader

from resonator_daemon.acquisition.host_time import HostTime
from resonator_daemon.acquisition.link import LinkUnavailableError
from resonator_daemon.acquisition.wire_events import WireEvent, decode
from resonator_daemon.plate import Plate

log = logging.getLogger(__name__)

PROFILE = "resonatord"
FORMAT = "1"
TOPIC = "wire"
ENCODING = "application/octet-stream"
RECORDING, BOARD = "recording", "board"  # metadata of the file

MARKS = "marks"
MARK_ENCODING = "json"
# One of the schemas that viewers of such files show as lines of text, in their place in time.
MARK_SCHEMA, MARK_SCHEMA_ENCODING = "foxglove.Log", "jsonschema"
MARK_SCHEMA_DATA: Final = {
    "title": MARK_SCHEMA,
    "type": "object",
    "properties": {
        "timestamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
        "level": {"type": "integer"},
        "message": {"type": "string"},
        "name": {"type": "string"},
        "file": {"type": "string"},
        "line": {"type": "integer"},
    },
}
_INFO_LEVEL = 2

_MAX_RECORD_BYTES = 64 << 20  # of MCAP; a chunk ends with the event that fills it
# What mcap, lz4 and `decode` raise about bytes that they cannot read.
_DAMAGE = (McapError, ValueError, KeyError, TypeError, RuntimeError, struct.error, OverflowError, MemoryError, OSError)


class Mark(NamedTuple):
    """What somebody had to say at that time; nothing on the link follows from it."""

    now: HostTime
    text: str


def encode_mark(mark: Mark) -> bytes:
    """Return the mark as a line of a log."""
    sec, nsec = divmod(mark.now.utc_ns, 10**9)
    line = {
        "timestamp": {"sec": sec, "nsec": nsec},
        "level": _INFO_LEVEL,
        "message": mark.text,
        "name": "mark",
        "file": "",
        "line": 0,
    }
    return json.dumps(line).encode()


def plate_fingerprints(plate: Plate) -> dict[str, str]:
    """Return what tells plates apart: name, all of the file, and what of it decides what is on the wire."""
    wire = hashlib.sha256(plate.counter.model_dump_json().encode())
    wire.update(plate.tones.f0_hz.tobytes())
    return {
        "plate": plate.name,
        "plate_sha256": hashlib.sha256(plate.model_dump_json().encode()).hexdigest(),
        "wire_sha256": wire.hexdigest(),
    }


class Recording:
    """An open recording.

    Parameters
    ----------
    path
        Names it in messages.
    header
        What was known when it was begun.

    Attributes
    ----------
    damage : str or None
        Why the events ended before the end, once they have; None where the file is whole.
    """

    def __init__(self, path: str, file: IO[bytes], header: dict[str, str], records: Iterator[McapRecord]) -> None:
        self.path = path
        self.header = header
        self._file = file
        self._records = records
        self.damage: str | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._file.close()

    def events(self) -> Iterator[WireEvent]:
        """Give the events in order, up to the end or to the first damage; marks among them go to the log."""
        channel = marks = None
        try:
            for record in self._records:
                if isinstance(record, Channel) and record.topic == TOPIC:
                    channel = record.id
                elif isinstance(record, Channel) and record.topic == MARKS:
                    marks = record.id
                elif isinstance(record, Message) and record.channel_id == marks:
                    log.info("%s: mark: %s", self.path, json.loads(record.data)["message"])
                elif isinstance(record, Message) and record.channel_id == channel:
                    yield decode(record.data, record.publish_time, record.log_time)
        except _DAMAGE as error:
            at = self._file.tell()
            whole = self._file.seek(0, 2)
            self.damage = "cut off" if at >= whole else f"damaged before byte {at} of {whole} ({error})"


def open_recording(path: str, plate: Plate) -> Recording:
    """Open a recording of a link to such a plate.

    Raises
    ------
    LinkUnavailableError
        No such file, no recording, of a newer version, or of a plate whose frames are others.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # a pipe would be waited for
            raise LinkUnavailableError(f"recording {path} is no regular file")
        file = open(path, "rb")  # noqa: SIM115 - the recording closes it
    except OSError as error:
        raise LinkUnavailableError(f"recording {path}: {error.strerror}") from error
    try:
        records = StreamReader(file, validate_crcs=True, record_size_limit=_MAX_RECORD_BYTES).records
        header = _header(path, records)
        _check_plate(path, header, plate)
    except BaseException:
        file.close()
        raise
    return Recording(path, file, header, records)


def _header(path: str, records: Iterator[McapRecord]) -> dict[str, str]:
    try:
        first, second = next(records), next(records)
    except (*_DAMAGE, StopIteration) as error:
        raise LinkUnavailableError(f"{path} is no recording, or nothing of it was written: {error}") from error
    if not isinstance(first, Header) or first.profile != PROFILE:
        raise LinkUnavailableError(f"{path} is an MCAP file, but not of this program")
    if not isinstance(second, Metadata) or second.name != RECORDING:
        raise LinkUnavailableError(f"{path} does not say what it is a recording of")
    if (version := second.metadata.get("format")) != FORMAT:
        raise LinkUnavailableError(
            f"{path} has format {version}, this version reads format {FORMAT}; replay it with the version that wrote it"
        )
    return dict(second.metadata)


def _check_plate(path: str, header: dict[str, str], plate: Plate) -> None:
    expected = plate_fingerprints(plate)
    if header.get("plate") != plate.name:
        raise LinkUnavailableError(
            f"{path} is a recording of plate {header.get('plate')!r}, the configuration names plate {plate.name!r}"
        )
    if header.get("wire_sha256") != expected["wire_sha256"]:
        raise LinkUnavailableError(
            f"{path} was recorded with another [counter] or other tones than plate {plate.name!r} has now; "
            "name the plate file that it was recorded with"
        )
    if header.get("plate_sha256") != expected["plate_sha256"]:
        log.warning("%s: plate file %r has changed since; frames are as recorded, forces may differ", path, plate.name)
