"""Export of what follows from a recording, to files of other formats."""

import hashlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from resonator_daemon.base.errors import ExitCode, UsageError, UserError, meaning_of
from resonator_daemon.base.host.files import takes_a_stream
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.toml import nearest
from resonator_daemon.board.config import Config
from resonator_daemon.board.recording.reader import FilePath, open_file
from resonator_daemon.mqtt.payload_types import UNITS
from resonator_daemon.tools.export import format_class, formats
from resonator_daemon.tools.export.output import Output, Recorded
from resonator_daemon.tools.replay.recorded_pipeline import Moment, RecordingReplay, open_replay
from resonator_daemon.tools.replay.span import Progress, Span, find_span


class Target(NamedTuple):
    """Named output, name of the format, and paths of the topics to be exported."""

    output: Path
    form: str
    topics: tuple[str, ...]


def make_target(output: Path, form: str | None, topics: str | None) -> Target:
    """Return what is to be written where.

    Parameters
    ----------
    output
        As it was given.
    form
        One of `formats`; None: by the ending of `output`.
    topics
        Paths of topics with commas between them; None: all that the format can have.

    Raises
    ------
    UsageError
        They do not go together.
    """
    if str(output) == "-":
        raise UsageError(
            "--output - would be stdout, and files are written; name one (resonatord replay --to - prints)"
        )
    endings = {f".{name}": name for name in formats()}
    if form is None and output.suffix not in endings:
        known = ", ".join(endings)
        raise UsageError(f"--output {str(output)!r} ends in none of {known}; name such a file, or give --format")
    form = form or endings[output.suffix]
    kind = format_class(form)
    chosen = kind.available if topics is None else tuple(dict.fromkeys(topics.split(",")))
    if unknown := [topic for topic in chosen if topic not in kind.available]:
        takes = "; ".join(f"got {topic!r}; {form}: {nearest(topic, kind.available)}" for topic in unknown)
        raise UsageError(f"--topics: {takes}")
    if kind.file_per_topic and len(chosen) > 1 and takes_a_stream(output):
        raise UsageError(f"--output {output} takes one table of {form}, not {len(chosen)}; choose it by --topics")
    return Target(output, form, chosen)


def recordings_in(paths: Sequence[Path]) -> list[Path]:
    """Return the named recordings, and the .mcap files of named directories; UsageError where one has none."""
    found: list[Path] = []
    for path in paths:
        files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
        if not files:
            raise UsageError(f"{path} has no recording, as run.mcap")
        found += files
    return list(dict.fromkeys(found))


def export(
    paths: Sequence[Path],
    target: Target,
    config: Config | None,
    start: str | None,
    end: str | None,
    *,
    show_progress: bool,
) -> tuple[dict[str, Any], Sequence[str]]:
    """Export recordings as one; return what came of it by the keys of `--json`, and what is wrong with it.

    Parameters
    ----------
    paths
        Recordings of one plate, in any order: they are exported in that of their beginnings.
    config
        Instead of the plate and settings that the recordings carry.
    start, end
        Mark or seconds of the only recording; None: its own.

    Raises
    ------
    UserError
        The options cannot be used, or the files cannot be written.
    LinkUnavailableError
        A file is no recording.
    """
    begun_s = time.monotonic()
    kind = format_class(target.form)
    kind.check(target.output, target.topics)
    if len(paths) > 1 and (start is not None or end is not None):
        raise UsageError("--from and --until belong to one recording; name one FILE, or leave them out")
    spans = {path: find_span(path, start, end) for path in paths}
    ordered = sorted(paths, key=lambda path: spans[path].begun.utc_ns)
    with open_replay(ordered[0], config) as first:
        metadata = [file_metadata(path, first.config) for path in ordered]
        sources = {key: ",".join(each[key] for each in metadata) for key in ("source", "source_sha256")}
        output = kind(target.output, target.topics, Recorded(first.config, metadata[0] | sources))
    played = _Played(ordered, spans, config, output, show_progress)
    files = _write(output, target.output, played.moments())
    wrong = list(played.wrong)
    if not output.rows:
        wrong.append(f"{ordered[0]}: it gives no messages of {', '.join(target.topics)}{spans[ordered[0]].words}")
    summary = {
        "file": str(ordered[0]),
        "recordings": [str(path) for path in ordered],
        "format": target.form,
        "files": files,
        "rows": dict(output.rows),
        "frames": played.frames,
        "differences": played.differences,
        "damage": played.damage,
        "took_seconds": round(time.monotonic() - begun_s, 3),
    }
    return summary, wrong


@dataclass
class _Played:
    """Recordings played one after the other, and what came of all of them."""

    paths: Sequence[Path]
    spans: Mapping[Path, Span]
    config: Config | None
    output: Output
    show_progress: bool
    frames: int = 0
    differences: int = 0
    damage: str | None = None  # of the first that is damaged
    wrong: list[str] = field(default_factory=list)

    def moments(self) -> Iterator[Moment]:
        plate: Plate | None = None
        for path in self.paths:
            with open_replay(path, self.config) as replaying, Progress(path, shown=self.show_progress) as progress:
                if plate is not None and replaying.config.plate != plate:
                    raise UsageError(f"{path} is of another plate, or calibration, than {self.paths[0]}")
                plate = replaying.config.plate
                if not self.output.start(path, self.spans[path].words, replaying.config):
                    continue
                yield from moments_within(replaying, self.spans[path], progress)
                self.frames += replaying.counters.frames
                self.differences += replaying.differences
                self.damage = self.damage or replaying.damage
                self.wrong += [f"{path}: {sentence}" for sentence in differences_in_words(replaying, "exported")]


def _write(output: Output, path: Path, moments: Iterator[Moment]) -> dict[str, int]:
    """Write all moments; return the size in bytes of each file."""
    try:
        output.begin()
        for moment in moments:
            output.add(moment)
        return output.close()
    except BaseException as error:
        output.discard()
        if not isinstance(error, OSError):
            raise
        removed = "" if takes_a_stream(path) else f"; {output.kept or 'what was written of it is removed'}"
        why = f"{path} cannot be written: {meaning_of(error)}{removed}"
        raise UserError(why, code="output", exit_code=ExitCode.FAILED) from error


def moments_within(replaying: RecordingReplay, span: Span, progress: Progress | None = None) -> Iterator[Moment]:
    """Yield the moments of a part of a recording."""
    for moment in replaying.moments():
        if progress is not None:
            progress.at(replaying.read_bytes)
        if span.is_over(moment.now):
            return
        if not span.is_before(moment.now):
            yield moment


def file_metadata(path: FilePath, config: Config) -> dict[str, str]:
    """Return what exported tables state about a recording: its file, plate and calibration, and the table of units."""
    with open_file(path) as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return {**table_metadata(Path(str(path)).name, config), "source_sha256": sha256}


def table_metadata(source: str, config: Config) -> dict[str, str]:
    """Return what exported tables state about the plate and calibration of their source, and the table of units."""
    plate = config.plate
    return {
        "resonatord_version": version("resonatord"),
        "source": source,
        "name": config.name or plate.name,
        "plate": plate.name,
        "calibration_id": plate.calibration.id or "",
        "units": json.dumps(UNITS),
    }


def differences_in_words(replaying: RecordingReplay, done: str) -> list[str]:
    """Return what is wrong with a recording that was played, a sentence each; `done` is what was done with the rest."""
    wrong = replaying.problems(done)
    if replaying.refused:
        wrong.append(f"the board was refused: {'; '.join(replaying.refused)}")
    return wrong
