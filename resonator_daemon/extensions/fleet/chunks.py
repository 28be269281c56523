"""Chunks of recordings: parts that are decoded independently, each from a moment without touches."""

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from resonator_daemon.base.errors import NoRecordingError
from resonator_daemon.base.plate import Plate
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.tables import Decoding
from resonator_daemon.board.config.values import Settings, load_plate_text, load_settings_text
from resonator_daemon.board.links.link import LinkUnavailableError
from resonator_daemon.board.recording.event_replay import Replay
from resonator_daemon.board.recording.reader import FilePath, Recording, open_recording
from resonator_daemon.board.recording.remote import local_file, matching_urls, without_secrets
from resonator_daemon.board.session.clock import HostTime
from resonator_daemon.board.session.frame_queue import FrameQueue
from resonator_daemon.board.session.link_state_machine import LinkStateMachine
from resonator_daemon.extensions.fleet.outline import Outline, read_outline
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.tools.replay.recorded_pipeline import recorded_config


@dataclass(frozen=True)
class Job:
    """Settings of one run, equal for all recordings.

    Parameters
    ----------
    output
        Directory of the results.
    topics
        Paths of the topics to be written.
    plate_text, settings_text
        TOML of a plate file, and of the tables [measurement] and [decoding]; None: those in each recording.
    chunk_s
        Least length of a chunk in seconds.
    """

    output: Path
    topics: tuple[str, ...]
    plate_text: str | None = None
    settings_text: str | None = None
    chunk_s: float = 60.0

    @property
    def plate(self) -> Plate | None:
        return None if self.plate_text is None else load_plate_text(self.plate_text, Path("--plate"))

    def config(self, recording: Recording) -> Config:
        """Return the configuration with which a recording is decoded.

        Raises
        ------
        ConfigurationError
            The recording contains none, or plate and settings are incompatible.
        """
        settings: Settings | None = None
        if self.settings_text is not None:
            settings = load_settings_text(self.settings_text, Path("--settings"))
        return recorded_config(recording, self.plate, settings)


@dataclass(frozen=True)
class Chunk:
    """One chunk of a recording; it ends at the first rest of a later chunk.

    Parameters
    ----------
    path
        File of the recording, or its URL.
    outline
        Of the recording; its parts are the chunks.
    number
        Number of the chunk in the recording, from 0.
    """

    path: str
    outline: Outline
    number: int

    @property
    def key(self) -> str:
        """Name of the chunk; equal recordings and chunk lengths give equal names."""
        return f"{self.outline.identity}-{self.number:05}"

    @property
    def begin_ns(self) -> int:
        """UTC of its first message."""
        return self.outline.starts[self.number].utc_ns

    @property
    def length_bytes(self) -> int:
        return self.end_bytes(self.number) - self.outline.starts[self.number].begin_bytes

    def end_bytes(self, number: int) -> int:
        """Return the file position at which a chunk of this recording ends."""
        starts = self.outline.starts
        return starts[number + 1].begin_bytes if number + 1 < len(starts) else self.outline.size_bytes

    def boundaries_bytes(self, last: int) -> list[int]:
        """Return the file positions at which this chunk begins, and at which it and each chunk up to `last` end."""
        ends = (self.end_bytes(number) for number in range(self.number, last + 1))
        return [self.outline.starts[self.number].begin_bytes, *ends]

    def is_described_by(self, report: dict[str, Any]) -> bool:
        """Return whether a report is of the same bytes of the recording, or of more, such as a longer copy."""
        reported: list[int] = report["boundaries_bytes"]
        return reported >= self.boundaries_bytes(len(self.outline.starts) - 1)[: len(reported)]


class Span(NamedTuple):
    """Part of a recording that a chunk decodes.

    Attributes
    ----------
    begin, end
        Times of begin and end; None: those of the recording.
    boundaries_bytes
        Boundaries of the chunks on which this depends: up to the one with the rest at which the chunk ends.
    is_empty
        The chunk has no rest: its frames belong to the chunk before.
    damage
        Why the search for a rest ended early, if it is empty.
    """

    begin: HostTime | None
    end: HostTime | None
    boundaries_bytes: list[int]
    is_empty: bool = False
    damage: str | None = None


def recordings_of(patterns: Sequence[str]) -> list[str]:
    """Return absolute paths, or URLs, of the files that match patterns, and of `*.mcap` in directories.

    Raises
    ------
    NoRecordingError
        A pattern matches no file.
    MissingLibraryError, OSError
        The library of a URL is not installed, or its server refuses the list.
    """
    paths: list[str] = []
    for pattern in patterns:
        matches = [Path(name).absolute() for name in sorted(glob.glob(pattern, recursive=True))]
        found = [str(file) for path in matches for file in (sorted(path.glob("*.mcap")) if path.is_dir() else [path])]
        found += matching_urls(pattern) if "://" in pattern else []
        if not found:
            raise NoRecordingError(f"no file matches {without_secrets(pattern)!r}; name recordings, as 'runs/*.mcap'")
        paths += found
    return paths


def chunks_of(path: str, job: Job) -> list[Chunk]:
    """Return the chunks of a recording; recordings of force plates are one chunk.

    Raises
    ------
    LinkUnavailableError
        The file is no recording, or the job has another plate.
    ConfigurationError
        The recording contains no plate or settings, or they are incompatible with those of the job.
    """
    with local_file(path) as file:
        with open_recording(file, job.plate) as recording:
            config = job.config(recording)
        independent_at_rest = sensor_of(config.plate, config.measurement, config.decoding).independent_at_rest
        outline = read_outline(file, job.chunk_s if independent_at_rest else float("inf"))
    if not independent_at_rest:
        outline = outline._replace(starts=outline.starts[:1])
    return [Chunk(path, outline, number) for number in range(len(outline.starts))]


def plan(paths: Sequence[str], job: Job) -> tuple[list[Chunk], dict[str, str]]:
    """Return the chunks of all recordings, and by path the reason why a file cannot be decoded.

    Of copies of one recording, the longest counts.
    """
    recordings: dict[str, list[Chunk]] = {}
    refused: dict[str, str] = {}
    for path in paths:
        try:
            found = chunks_of(path, job)
        except LinkUnavailableError as error:
            refused[path] = str(error)
            continue
        if not found:
            refused[path] = f"{without_secrets(path)} has no events; record again"
            continue
        other = recordings.get(found[0].outline.identity, found)
        longest = max(other, found, key=lambda chunks: chunks[0].outline.size_bytes)
        recordings[found[0].outline.identity] = longest
    return [chunk for chunks in recordings.values() for chunk in chunks], refused


def first_rest(file: FilePath, chunk: Chunk, number: int, config: Config) -> tuple[HostTime | None, str | None]:
    """Return the time at which the plate is first at rest in a chunk of this recording, and any damage before.

    The time is None if it never is. It depends on the bytes of that chunk alone, so that the chunk and the one before
    agree.
    """
    with open_recording(file, config.plate) as recording:
        recording.resume_at(chunk.outline.starts[number].begin_bytes, chunk.outline.channels)
        undecoded = config.model_copy(update={"decoding": Decoding(method="off")})
        queue = FrameQueue(1 << 30, lambda: None, ())
        replay = Replay(recording, LinkStateMachine(config.plate, queue, lambda _: None))
        board = BoardPipeline(undecoded, "", lambda *_: None)
        for event in recording.events():
            if recording.read_bytes > chunk.end_bytes(number):
                break
            replay.apply(event)
            for arrival in queue.pop_all():
                board.handle(arrival)
            if board.sensor.at_rest:
                return event.now, None
        return None, recording.damage


def span_of(file: FilePath, chunk: Chunk, config: Config) -> Span:
    """Return the span of a chunk of a file. Frames before its first rest belong to the chunk before."""
    begin = None
    if chunk.number:
        begin, damage = first_rest(file, chunk, chunk.number, config)
        if begin is None:
            return Span(None, None, chunk.boundaries_bytes(chunk.number), is_empty=True, damage=damage)
    for number in range(chunk.number + 1, len(chunk.outline.starts)):
        end, _ = first_rest(file, chunk, number, config)
        if end is not None:
            return Span(begin, end, chunk.boundaries_bytes(number))
    return Span(begin, None, chunk.boundaries_bytes(len(chunk.outline.starts) - 1))
