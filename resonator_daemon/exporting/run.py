"""Export of what follows from a recording, to files of other formats."""

import hashlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn, Protocol

from resonator_daemon.config import Config
from resonator_daemon.config.text import plate_text, settings_text
from resonator_daemon.errors import ExitCode, UserError
from resonator_daemon.exporting.formats import CSV, MCAP, NPZ, PARQUET
from resonator_daemon.exporting.target import Target
from resonator_daemon.host.new_file import check_new, takes_a_stream
from resonator_daemon.publishing.units import UNITS
from resonator_daemon.recording.reader import PLATE_FILE, SETTINGS_FILE
from resonator_daemon.replay.progress import Progress
from resonator_daemon.replay.recorded_pipeline import Moment, Playback
from resonator_daemon.replay.source import open_playback
from resonator_daemon.replay.span import Span, find_span


class ExportFailedError(UserError):
    """What is read could not be written."""

    exit_code = ExitCode.FAILED
    code = "output"


class Output(Protocol):
    """Takes what follows from a recording.

    Attributes
    ----------
    rows : Mapping
        How many of what was taken, by topic.
    """

    @property
    def rows(self) -> Mapping[str, int]: ...
    def take(self, moment: Moment) -> None: ...
    def close(self) -> Mapping[str, int]:
        """Make the files whole; returns the size in bytes of each."""
        ...

    def discard(self) -> None:
        """Remove what there is of the files."""
        ...


def export(
    path: Path, target: Target, config: Config | None, start: str | None, end: str | None, *, show_progress: bool
) -> tuple[dict[str, Any], Sequence[str]]:
    """Export a recording; return what came of it by the keys of `--json`, and what is wrong with it.

    Parameters
    ----------
    config
        Instead of the plate and settings that the recording carries.
    start, end
        Mark or seconds; None: the recording's own.

    Raises
    ------
    UserError
        The options cannot be used, or the files cannot be written.
    LinkUnavailableError
        The file is no recording.
    """
    begun_s = time.monotonic()
    for topic in target.topics:
        check_new(target.place(topic))
    span = find_span(path, start, end)
    with open_playback(path, config) as playback:
        output, files = _written(path, playback, target, span, shown=show_progress)
        summary = {
            "file": str(path),
            "format": target.form,
            "files": dict(files),
            "rows": dict(output.rows),
            "frames": playback.counters.frames,
            "differences": playback.differences,
            "damage": playback.damage,
            "took_seconds": round(time.monotonic() - begun_s, 3),
        }
        return summary, _what_is_wrong(playback, output, target, span)


def _written(
    path: Path, playback: Playback, target: Target, span: Span, *, shown: bool
) -> tuple[Output, Mapping[str, int]]:
    with _said(target.output):
        output = _output(path, playback.config, target)
        try:
            with Progress(path, shown=shown) as progress:
                for moment in _part(playback, span):
                    progress.at(playback.read_bytes)
                    output.take(moment)
            return output, output.close()
        except BaseException:
            output.discard()
            raise


def _part(playback: Playback, span: Span) -> Iterator[Moment]:
    for moment in playback.moments():
        if span.is_over(moment.now):
            return
        if not span.is_before(moment.now):
            yield moment


@contextmanager
def _said(output: Path) -> Iterator[None]:
    """Report a full disk in one line."""
    try:
        yield
    except OSError as error:
        _fail(output, error)


def _fail(output: Path, error: OSError) -> NoReturn:
    removed = "" if takes_a_stream(output) else "; what was written of it is removed"
    raise ExportFailedError(f"{output} cannot be written: {error.strerror or error}{removed}") from error


def _output(path: Path, config: Config, target: Target) -> Output:
    plate, name = config.plate, config.name or config.plate.name
    metadata = {
        "resonatord_version": version("resonatord"),
        "source": path.name,
        "source_sha256": _sha256(path),
        "name": name,
        "plate": plate.name,
        "calibration_id": plate.calibration.id or "",
        "units": json.dumps(UNITS),
    }
    # Each needs libraries that the others can do without.
    if target.form == MCAP:
        from resonator_daemon.exporting.mcap_file import McapOutput

        texts = {PLATE_FILE: plate_text(plate), SETTINGS_FILE: settings_text(config)}
        return McapOutput(target.output, target.topics, plate, name, metadata, texts)
    if target.form in (CSV, NPZ, PARQUET):
        return _tables(config, target, metadata)
    from resonator_daemon.exporting.ros2_file import Ros2Output

    return Ros2Output(target.output, target.topics, plate, name, metadata)


def _tables(config: Config, target: Target, metadata: Mapping[str, str]) -> Output:
    from resonator_daemon.exporting.table_output import TableFormat, TableOutput

    made: TableFormat
    if target.form == CSV:
        from resonator_daemon.exporting.csv_file import CsvFormat

        made = CsvFormat(target.place)
    elif target.form == NPZ:
        from resonator_daemon.exporting.npz_file import NpzFormat

        made = NpzFormat(target.output, metadata)
    else:
        from resonator_daemon.exporting.parquet_file import ParquetFormat

        made = ParquetFormat(target.place, metadata)
    return TableOutput(made, target.topics, config.plate)


def _what_is_wrong(playback: Playback, output: Output, target: Target, span: Span) -> Sequence[str]:
    wrong = []
    if playback.damage is not None:
        wrong.append(f"the file is {playback.damage}; all before that was exported")
    if playback.differences:
        wrong.append(f"the replay differs from what is recorded in {playback.differences} places")
    if playback.refused:
        wrong.append(f"the board was refused: {'; '.join(playback.refused)}")
    if not output.rows:
        wrong.append(f"it gives no messages of {', '.join(target.topics)}{span.words}")
    return wrong


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
