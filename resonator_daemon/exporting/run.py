"""`resonatord export`: what follows from a recording, in a file of another format."""

import argparse
import hashlib
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn, Protocol

from resonator_daemon.config import Config, load_config
from resonator_daemon.config.text import plate_text, settings_text
from resonator_daemon.errors import ExitCode, UserError, failure_told
from resonator_daemon.exporting.options import CSV, MCAP, NPZ, PARQUET
from resonator_daemon.exporting.target import Target, target
from resonator_daemon.host.new_file import check_new, interruptible, takes_a_stream
from resonator_daemon.host.printable import printable
from resonator_daemon.links.link import LinkUnavailableError
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


class NotExportableError(UserError):
    """The file is no recording that can be replayed."""

    exit_code = ExitCode.UNAVAILABLE
    code = "no_recording"


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


def export_as_asked(options: argparse.Namespace) -> ExitCode:
    """Export, and say what came of it.

    Raises
    ------
    UserError
        The recording, the configuration or the options cannot be used, or the files cannot be written.
    """
    asked = target(options)
    ended = "a part of it was written" if takes_a_stream(asked.output) else "what was written is removed"
    with failure_told("export", as_json=options.json), interruptible(ended):
        try:
            told, wrong = _export(options, asked)
        except LinkUnavailableError as error:
            raise NotExportableError(printable(str(error))) from error
    if options.json:
        sys.stdout.write(json.dumps({"verb": "export", "ok": not wrong, **told}) + "\n")
    else:
        for path, size_bytes in told["files"].items():
            sys.stderr.write(f"{printable(path)}: {size_bytes / 1e3:.0f} kB\n")
        counts = ", ".join(f"{count} of {topic}" for topic, count in told["rows"].items())
        sys.stderr.write(f"{told['frames']} frames gave {counts or 'nothing'}\n")
    for sentence in wrong:
        sys.stderr.write(f"resonatord: {printable(f'{options.file}: {sentence}')}\n")
    return ExitCode.FAILED if wrong else ExitCode.DONE


def _export(options: argparse.Namespace, asked: Target) -> tuple[dict[str, Any], Sequence[str]]:
    path: Path = options.file
    begun_s = time.monotonic()
    for topic in asked.topics:
        check_new(asked.place(topic))
    config = load_config(options.config) if options.config is not None else None
    span = find_span(path, options.start, options.end)
    with open_playback(path, config) as playback:
        output, files = _written(path, playback, asked, span, shown=not options.json)
        told = {
            "file": str(path),
            "format": asked.form,
            "files": dict(files),
            "rows": dict(output.rows),
            "frames": playback.counters.frames,
            "differences": playback.differences,
            "damage": playback.damage,
            "took_seconds": round(time.monotonic() - begun_s, 3),
        }
        return told, _what_is_wrong(playback, output, asked, span)


def _written(
    path: Path, playback: Playback, asked: Target, span: Span, *, shown: bool
) -> tuple[Output, Mapping[str, int]]:
    with _said(asked.output):
        output = _output(path, playback.config, asked)
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
    """Have it said in one line where the disk takes nothing more."""
    try:
        yield
    except OSError as error:
        _fail(output, error)


def _fail(output: Path, error: OSError) -> NoReturn:
    removed = "" if takes_a_stream(output) else "; what was written of it is removed"
    raise ExportFailedError(f"{output} cannot be written: {error.strerror or error}{removed}") from error


def _output(path: Path, config: Config, asked: Target) -> Output:
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
    if asked.form == MCAP:
        from resonator_daemon.exporting.mcap_file import McapOutput

        texts = {PLATE_FILE: plate_text(plate), SETTINGS_FILE: settings_text(config)}
        return McapOutput(asked.output, asked.topics, plate, name, metadata, texts)
    if asked.form in (CSV, NPZ, PARQUET):
        return _tables(config, asked, metadata)
    from resonator_daemon.exporting.ros2_file import Ros2Output

    return Ros2Output(asked.output, asked.topics, plate, name, metadata)


def _tables(config: Config, asked: Target, metadata: Mapping[str, str]) -> Output:
    from resonator_daemon.exporting.table_output import TableFormat, TableOutput

    made: TableFormat
    if asked.form == CSV:
        from resonator_daemon.exporting.csv_file import CsvFormat

        made = CsvFormat(asked.place)
    elif asked.form == NPZ:
        from resonator_daemon.exporting.npz_file import NpzFormat

        made = NpzFormat(asked.output, metadata)
    else:
        from resonator_daemon.exporting.parquet_file import ParquetFormat

        made = ParquetFormat(asked.place, metadata)
    return TableOutput(made, asked.topics, config.plate)


def _what_is_wrong(playback: Playback, output: Output, asked: Target, span: Span) -> Sequence[str]:
    wrong = []
    if playback.damage is not None:
        wrong.append(f"the file is {playback.damage}; all before that was exported")
    if playback.differences:
        wrong.append(f"the replay differs from what is recorded in {playback.differences} places")
    if playback.refused:
        wrong.append(f"the board was refused: {'; '.join(playback.refused)}")
    if not output.rows:
        wrong.append(f"it gives no messages of {', '.join(asked.topics)}{span.words}")
    return wrong


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
