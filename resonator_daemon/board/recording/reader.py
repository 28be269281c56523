"""The file of a recording: an MCAP container with one message for each event on a link; read in order."""

import fcntl
import hashlib
import json
import logging
import os
import re
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from io import BufferedReader
from itertools import chain, dropwhile
from pathlib import Path
from typing import IO, Final, NamedTuple, Self

from mcap.records import Attachment, Header, McapRecord, Metadata

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.host.text import printable
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording.mcap_messages import (
    READ_ERRORS,
    Damage,
    DamagedAttachment,
    messages,
    read_records,
)
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.link_events import SnapshotTaken, WireEvent, decode

log = logging.getLogger(__name__)

FilePath = str | os.PathLike[str]  # `str` of it names the file in messages
SHORTENED_URL: Final = re.compile(r"\w+:/[^/]")  # begins a path that was made of a URL, and lost one slash

STILL_WRITTEN: Final = "still being written"  # damage of a file whose end is to come

PROFILE = "resonatord"
FORMAT = "2"
TOPIC = "wire"
WIRE_CHANNEL: Final = 1  # in each file
ENCODING = "application/octet-stream"
RECORDING, BOARD, CHANNEL = "recording", "board", "channel"  # metadata of the file
PLATE_FILE, SETTINGS_FILE = "plate.toml", "settings.toml"  # attachments
DESCRIPTION_FILE: Final = "recording.json"  # attachment: metadata `recording` once more, with a checksum

MARKS = "marks"
JSON_ENCODING, JSON_SCHEMA_ENCODING = "json", "jsonschema"
# One of the schemas that viewers of such files show as lines of text, in their place in time.
MARK_SCHEMA = "foxglove.Log"
MARK_SCHEMA_DATA: Final[dict[str, object]] = json.loads(
    Path(__file__).with_name("log_schema.json").read_text(encoding="utf-8")
)
INFO_LEVEL = 2  # before WARNING and ERROR


class Mark(NamedTuple):
    """A text that somebody wrote at that time; it has no effect on the link."""

    now: HostTime
    text: str


def encode_mark(mark: Mark) -> bytes:
    """Return the mark as a line of a log."""
    return log_line(mark.now.utc_ns, INFO_LEVEL, "mark", mark.text)


def log_line(utc_ns: int, level: int, name: str, text: str) -> bytes:
    """Return a line of a log as JSON of MARK_SCHEMA."""
    line = {"timestamp": json_time(utc_ns), "level": level, "message": text, "name": name, "file": "", "line": 0}
    return json.dumps(line).encode()


def json_time(utc_ns: int) -> dict[str, int]:
    """Return a time as JSON of `timestamp` in MARK_SCHEMA."""
    sec, nsec = divmod(utc_ns, 10**9)
    return {"sec": sec, "nsec": nsec}


def plate_fingerprints(plate: Plate) -> dict[str, str]:
    """Return fingerprints of a plate: name, hash of the file, and hash of what decides the frames."""
    wire = hashlib.sha256(plate.counter.model_dump_json(exclude={"sensor"}).encode())
    wire.update(plate.tones.f0_hz.tobytes())
    return {
        "plate": plate.name,
        "plate_sha256": hashlib.sha256(plate.model_dump_json().encode()).hexdigest(),
        "wire_sha256": wire.hexdigest(),
    }


class RecordingUnusableError(LinkUnavailableError):
    """A file is no recording, or none that this version or plate can replay."""

    def __init__(self, text: str) -> None:
        super().__init__(ReasonCode.RECORDING_UNUSABLE, text)


@dataclass(frozen=True)
class Origin:
    """What is recorded; written to the beginning of each file.

    Parameters
    ----------
    plate, link
        Those of the board.
    name, daemon_boot_id
        Of the daemon whose link it is; None where no daemon runs.
    config_sha256
        Hash by which configurations are distinguished.
    plate_text, settings_text
        TOML of the plate file, and of the tables [measurement] and [decoding].
    """

    plate: Plate
    link: str
    name: str | None = None
    daemon_boot_id: str | None = None
    config_sha256: str | None = None
    plate_text: str | None = None
    settings_text: str | None = None

    @property
    def metadata(self) -> dict[str, str]:
        """Everything but the texts; what is None is left out."""
        known = {
            "format": FORMAT,
            "link": self.link,
            "version": version("resonatord"),
            **plate_fingerprints(self.plate),
            "name": self.name,
            "daemon_boot_id": self.daemon_boot_id,
            "calibration_id": self.plate.calibration.id,
            "config_sha256": self.config_sha256,
        }
        return {key: value for key, value in known.items() if value is not None}

    @property
    def attachments(self) -> dict[str, str]:
        """The texts by the names of the attachments that carry them."""
        texts = {PLATE_FILE: self.plate_text, SETTINGS_FILE: self.settings_text}
        return {name: text for name, text in texts.items() if text is not None}


def damage_in_words(damage: str, done: str) -> str:
    """Return a sentence for the damage of a file, what was done with what came before it, and the remedy."""
    if damage == STILL_WRITTEN:
        return f"the file is {damage}; all that it has so far was {done}; repeat this when its recording has ended"
    return f"the file is {damage}; all before that was {done}; resonatord repair FILE copies all complete parts"


def is_being_written(file: IO[bytes]) -> bool:
    """Return whether a writer holds its lock on a file; False on a file system without locks."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    fcntl.flock(file, fcntl.LOCK_UN)
    return False


@dataclass(eq=False)
class Recording:
    """An open recording.

    Parameters
    ----------
    path
        Names it in messages.
    header
        What was known when it was begun.
    damaged_attachments
        Names, as far as they can be read, of those that are not what was written.

    Attributes
    ----------
    damage : str or None
        Why the events ended before the end, once they have; None where the file is whole.
    """

    path: str
    header: dict[str, str]
    damaged_attachments: tuple[str, ...]
    _attachments: dict[str, str]
    _file: IO[bytes]
    _records: Iterator[McapRecord]
    damage: str | None = None
    _channels: Mapping[int, str] = field(default_factory=dict)  # those that were declared before `_records`
    _resumed: bool = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def plate_text(self) -> str | None:
        """The plate file as it was, in TOML; None where the file does not have it whole."""
        return self._attachments.get(PLATE_FILE)

    @property
    def settings_text(self) -> str | None:
        """The tables [measurement] and [decoding] as they were, in TOML; None where they are not whole in the file."""
        return self._attachments.get(SETTINGS_FILE)

    @property
    def read_bytes(self) -> int:
        """How much of the file was read."""
        return self._file.tell()

    def events(self) -> Iterator[WireEvent]:
        """Give the events in order, up to the end or to the first damage; marks among them go to the log."""
        for entry in self.entries():
            if isinstance(entry, Mark):
                log.info("%s: mark: %s", self.path, entry.text)
            else:
                yield entry

    def resume_at(self, begin_bytes: int, channels: Mapping[int, str]) -> None:
        """Go on with the first snapshot of an open link behind this byte, at which a record of the file begins.

        Parameters
        ----------
        channels
            Topics of the channels that records before it have declared.
        """
        self._records = read_records(self._file, begin_bytes)
        self._channels = channels
        self._resumed = True

    def entries(self) -> Iterator[WireEvent | Mark]:
        """Give events and marks in order, up to the end or to the first damage."""
        return dropwhile(_is_before_a_snapshot, self._all_entries()) if self._resumed else self._all_entries()

    def _all_entries(self) -> Iterator[WireEvent | Mark]:
        try:
            for topic, data, publish_ns, log_ns in messages(self._intact(), (TOPIC, MARKS), self._channels):
                if topic == TOPIC:
                    yield decode(data, publish_ns, log_ns)
                else:  # which does not have the host's time since boot
                    now = HostTime(publish_ns, log_ns - publish_ns, 0)
                    yield Mark(now, str(json.loads(data)["message"]))
        except READ_ERRORS as error:
            self._end(self._file.tell(), error)

    def _intact(self) -> Iterator[McapRecord]:
        for record in self._records:
            if isinstance(record, Damage):
                self._end(record.end_bytes, record.reason)
                return
            yield record

    def _end(self, at: int, error: Exception) -> None:
        whole = self._file.seek(0, os.SEEK_END)
        end = STILL_WRITTEN if is_being_written(self._file) else "cut off"
        self.damage = end if at >= whole else f"damaged before byte {at} of {whole} ({meaning_of(error)})"


def _is_before_a_snapshot(entry: WireEvent | Mark) -> bool:
    return not isinstance(entry, SnapshotTaken) or entry.snapshot.running is None


def open_recording(path: FilePath, plate: Plate | None = None) -> Recording:
    """Open a recording of a link; if a plate is given, the recording has to be of such a plate.

    Raises
    ------
    RecordingUnusableError
        The file is missing, no recording, of another format, or of a plate with other frames.
    """
    file = open_file(path)
    name = str(path)
    try:
        records = read_records(file)
        header = read_header(name, records)
        check_format(name, header)
        attachments, damaged, records = _attachments(records)
        if plate is not None:
            _check_plate(name, header, plate)
            for attachment in damaged:
                log.warning("%s: its attachment %s is damaged; the configuration counts", name, printable(attachment))
    except BaseException:
        file.close()
        raise
    return Recording(name, header, damaged, attachments, file, records)


def open_file(path: FilePath) -> BufferedReader:
    """Open a regular file. Raises RecordingUnusableError."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # opening a pipe would block
            raise RecordingUnusableError(f"recording {path} is no regular file")
        return open(path, "rb")
    except OSError as error:
        remedy = "; a URL is not a path here: download the file first" if SHORTENED_URL.match(str(path)) else ""
        raise RecordingUnusableError(f"recording {path}: {meaning_of(error)}{remedy}") from error


def read_header(path: str, records: Iterator[McapRecord]) -> dict[str, str]:
    """Read the first two records of a file; return its metadata.

    Raises
    ------
    RecordingUnusableError
        It is no recording.
    """
    first, second = next(records, None), next(records, None)
    if not isinstance(first, Header) or isinstance(second, Damage):
        raise no_recording(path, "; if it is damaged, resonatord repair FILE copies what is intact")
    if first.profile != PROFILE:
        raise RecordingUnusableError(f"{path} is an MCAP file, but no recording, as an export is none")
    if not isinstance(second, Metadata) or second.name != RECORDING:
        raise RecordingUnusableError(f"{path} does not contain the description of its plate or board")
    return dict(second.metadata)


def no_recording(path: str, remedy: str = "") -> RecordingUnusableError:
    """Return the error for a file that is no recording."""
    what = f"{path} is no recording, or nothing of it was written"
    return RecordingUnusableError(f"{what}; name a file that `resonatord record` has written{remedy}")


def check_format(path: str, header: dict[str, str]) -> None:
    """Check that a file is of the format that this version reads. Raises RecordingUnusableError."""
    if (number := header.get("format")) != FORMAT:
        raise RecordingUnusableError(
            f"{path} has format {number}, this version reads format {FORMAT}; replay it with the version that wrote it"
        )


def _attachments(
    records: Iterator[McapRecord],
) -> tuple[dict[str, str], tuple[str, ...], Iterator[McapRecord]]:
    """Read the attachments that come next; return them, the names of damaged ones, and the records that follow."""
    texts: dict[str, str] = {}
    damaged: list[str] = []
    for record in records:
        if isinstance(record, DamagedAttachment):
            damaged.append(record.name)
        elif isinstance(record, Attachment):
            try:
                texts[record.name] = record.data.decode()
            except UnicodeDecodeError:
                damaged.append(record.name)
        else:
            return texts, tuple(damaged), chain([record], records)
    return texts, tuple(damaged), records


def _check_plate(path: str, header: dict[str, str], plate: Plate) -> None:
    expected = plate_fingerprints(plate)
    if header.get("plate") != plate.name:
        raise RecordingUnusableError(
            f"{path} is a recording of plate {header.get('plate')!r}, the configuration names plate {plate.name!r}"
        )
    if header.get("wire_sha256") != expected["wire_sha256"]:
        raise RecordingUnusableError(
            f"{path} was recorded with another [counter] or other tones than plate {plate.name!r} has now; "
            "name the plate file that it was recorded with"
        )
    if header.get("plate_sha256") != expected["plate_sha256"]:
        log.warning("%s: plate file %r has changed since; frames are as recorded, forces may differ", path, plate.name)
