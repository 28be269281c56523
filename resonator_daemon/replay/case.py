"""A recording and what it is to become: made from a recording, to be compared with its replay later."""

import gzip
import hashlib
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, PositiveInt, ValidationError

from resonator_daemon.errors import ConfigurationError
from resonator_daemon.host.new_file import NoNewFileError, part_is_there, part_of
from resonator_daemon.host.system_limits import meaning_of
from resonator_daemon.replay.outputs import OutputFailedError, payload_json
from resonator_daemon.replay.recorded_pipeline import RecordingReplay
from resonator_daemon.replay.source import open_replay

RECORDING_FILE: Final = "recording.mcap"
EXPECTED_FILE: Final = "expected.jsonl.gz"
FORMAT: Final = 1
KEPT_BYTES: Final = 64_000  # of JSON of each stream: of one that has more, each second message, each fourth...


class ReplayedMessage(NamedTuple):
    """A message of a replay: the number of those on its topic before it, and when, in UTC, it was made."""

    topic: str
    number: int
    now_ns: int
    payload: str


@dataclass(frozen=True)
class Outcome:
    """What a replay came to.

    Parameters
    ----------
    summary
        Frames, losses, differences, messages by topic; of the streams, which messages are kept: each how manieth.
    kept
        Messages in their order.
    sha256
        Hash of all messages: equal if two replays are equal to the bit.
    differences, damage
        Of the replay and the recording.
    begun_ns
        UTC of its first message.
    """

    summary: dict[str, Any]
    kept: list[ReplayedMessage]
    sha256: str
    differences: int
    damage: str | None
    begun_ns: int


@dataclass
class _Kept:
    """Each `every`-th message of a topic, so that they take no more than a bound; None: all."""

    bound_bytes: int | None
    every: int = 1
    messages: list[tuple[int, ReplayedMessage]] = field(default_factory=list)  # with their place among all
    _size_bytes: int = 0

    def put(self, place: int, message: ReplayedMessage) -> None:
        if message.number % self.every:
            return
        self.messages.append((place, message))
        self._size_bytes += len(message.payload)
        while self.bound_bytes is not None and self._size_bytes > self.bound_bytes and len(self.messages) > 1:
            self.every *= 2
            self.messages = [(place, message) for place, message in self.messages if message.number % self.every == 0]
            self._size_bytes = sum(len(message.payload) for _, message in self.messages)


def replay_whole(replaying: RecordingReplay, every: Mapping[str, int] | None = None) -> Outcome:
    """Play a recording, and keep all messages that change something, and of the streams as many as are asked for.

    Parameters
    ----------
    every
        By topic: keep each so manieth message; None: as many as fit a case.
    """
    counts: Counter[str] = Counter()
    kept: dict[str, _Kept] = {}
    digest = hashlib.sha256()
    place = begun_ns = 0
    for moment in replaying.moments():
        for topic, message in moment.messages:
            path, payload = topic.path, payload_json(message)
            if path not in kept:
                fixed = every is not None or topic.qos == 1
                kept[path] = _Kept(None if fixed else KEPT_BYTES, every.get(path, 1) if every is not None else 1)
            kept[path].put(place, ReplayedMessage(path, counts[path], moment.now.utc_ns, payload))
            counts[path] += 1
            digest.update(f"{path} {payload}\n".encode())
            begun_ns = begun_ns or moment.now.utc_ns
            place += 1
    counters = replaying.counters
    summary = {
        "frames": counters.frames,
        "frames_lost": asdict(counters.lost),
        "differences": replaying.differences,
        "damaged": replaying.damage is not None,
        "refused": list(replaying.refused),
        "messages": dict(counts),
        "every": {path: topic.every for path, topic in kept.items()},
    }
    in_order = sorted((item for topic in kept.values() for item in topic.messages), key=lambda item: item[0])
    messages = [message for _, message in in_order]
    return Outcome(summary, messages, digest.hexdigest(), replaying.differences, replaying.damage, begun_ns)


def save_case(recording: Path, directory: Path) -> Outcome:
    """Make a case of a recording, in a new directory.

    Raises
    ------
    LinkUnavailableError, ConfigurationError
        The recording cannot be replayed with what it carries.
    NoNewFileError
        The directory is there already.
    OutputFailedError
        It cannot be written; nothing is left of it.
    """
    _check_free(directory)
    with open_replay(recording):
        pass  # it can be replayed
    part = part_of(directory)
    try:
        part.mkdir(parents=True)
    except FileExistsError as error:
        raise part_is_there(part) from error
    except OSError as error:
        raise OutputFailedError(f"{directory} cannot be made: {meaning_of(error)}") from error
    try:
        shutil.copyfile(recording, part / RECORDING_FILE)
        with open_replay(part / RECORDING_FILE) as replaying:  # whose name messages have
            outcome = replay_whole(replaying)
        write_expected(outcome, part)
        _check_free(directory)
        os.rename(part, directory)
    except OSError as error:
        raise OutputFailedError(f"{directory}: {meaning_of(error)}; what was written is removed") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return outcome


def _check_free(directory: Path) -> None:
    if os.path.lexists(directory):
        raise NoNewFileError(f"{directory} exists already, and nothing is overwritten; choose another directory")


def write_expected(outcome: Outcome, directory: Path) -> None:
    """Write what a replay is to come to into a case."""
    head = {"format": FORMAT, "sha256": outcome.sha256, **outcome.summary}
    lines = [json.dumps(head), *(_line(message) for message in outcome.kept)]
    with (directory / EXPECTED_FILE).open("wb") as file, gzip.GzipFile("", "wb", fileobj=file, mtime=0) as packed:
        packed.write("".join(f"{line}\n" for line in lines).encode())


def _line(message: ReplayedMessage) -> str:
    head = json.dumps({"topic": message.topic, "number": message.number, "now_ns": str(message.now_ns)})
    return f'{head[:-1]}, "payload": {message.payload}}}'


class _Head(BaseModel):
    """What the first line is to have; all of it but these two is the summary."""

    model_config = ConfigDict(strict=True)

    format: Literal[1]
    sha256: str
    messages: dict[str, NonNegativeInt]
    every: dict[str, PositiveInt]


class ExpectedMessage(BaseModel):
    """A message that a replay is to give, as `ReplayedMessage` is one that it gave."""

    model_config = ConfigDict(strict=True)

    topic: str
    number: NonNegativeInt
    now_ns: Annotated[str, Field(pattern=r"^[0-9]{1,20}$")]
    payload: dict[str, Any]


class Expected(NamedTuple):
    """Expected outcome of a case's recording."""

    summary: dict[str, Any]
    sha256: str
    messages: list[ExpectedMessage]

    @property
    def every(self) -> Mapping[str, int]:
        """By topic: each so manieth message is kept."""
        every: Mapping[str, int] = self.summary["every"]
        return every


def read_expected(directory: Path) -> Expected:
    """Read what a case expects.

    Raises
    ------
    ConfigurationError
        There is no such case, or its file cannot be read.
    """
    path = directory / EXPECTED_FILE
    try:
        lines = _objects(path)
        head = next(lines)
        if head["format"] != FORMAT:
            raise ConfigurationError(
                f"{path} has format {head['format']!r}, this version reads {FORMAT}; save the fixture again"
            )
        checked = _Head.model_validate(head)
        summary = {key: value for key, value in head.items() if key not in ("format", "sha256")}
        return Expected(summary, checked.sha256, [ExpectedMessage.model_validate(line) for line in lines])
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "line"
        raise ConfigurationError(f"{path} cannot be read ({key}: {first['msg']}); save the fixture again") from error
    except OSError as error:
        raise ConfigurationError(f"{path}: {meaning_of(error)}; replay --save-case makes fixtures") from error
    except (ValueError, EOFError, KeyError, TypeError, StopIteration, RecursionError) as error:
        raise ConfigurationError(f"{path} cannot be read ({error}); save the fixture again") from error


def _objects(path: Path) -> Iterator[dict[str, Any]]:
    with gzip.open(path, "rt", encoding="utf-8") as file:
        for line in file:
            yield json.loads(line)
