"""Decoding of one chunk, in any process, into its files: the result depends on the recording and the job only.

The files are Parquet by topic, plate and day, and a report, whose existence marks the chunk as done.
"""

import errno
import gc
import json
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from resonator_daemon.base.errors import ExitCode, UserError, meaning_of
from resonator_daemon.base.host.files import replace_file, sync_directory
from resonator_daemon.board.config import Config
from resonator_daemon.board.recording.reader import STILL_WRITTEN, Recording, open_recording
from resonator_daemon.board.recording.remote import local_file
from resonator_daemon.extensions.fleet.chunks import Chunk, Job, Span, span_of
from resonator_daemon.measure.sensors.output import utc_day
from resonator_daemon.measure.sensors.surface_decoding import SurfaceClient, SurfaceDecoding
from resonator_daemon.measure.sensors.surface_requests import SurfaceSettings
from resonator_daemon.measure.sensors.surface_worker import SequentialDecoding
from resonator_daemon.mqtt.codec import decoded
from resonator_daemon.mqtt.topics import DECODED, FORCES
from resonator_daemon.tools.export.output import Recorded
from resonator_daemon.tools.export.parquet import ParquetFormat
from resonator_daemon.tools.export.run import table_metadata
from resonator_daemon.tools.replay.recorded_pipeline import UNKNOWN_BOOT_ID, Moment, RecordingReplay

REPORTS = "chunks"  # directory of the reports
_PARTS = ".parts"  # directory of incomplete files
_NAME = "of.parquet"  # there; the format appends the topic to the stem
_NO_PLACE = (errno.ENOENT, errno.ENOTDIR, errno.EEXIST, errno.EACCES, errno.EPERM, errno.EROFS)


class OutputFailedError(UserError):
    """Results cannot be written, for example on a full disk."""

    exit_code = ExitCode.FAILED
    code = "output"


def report_path(output: Path, key: str) -> Path:
    """Return the path of a chunk's report, which exists once all files of the chunk are complete."""
    return output / REPORTS / f"{key}.json"


def read_report(output: Path, key: str) -> dict[str, Any] | None:
    """Return the report of a chunk; None if there is none, or it is unreadable."""
    with suppress(FileNotFoundError, ValueError):
        report: dict[str, Any] = json.loads(report_path(output, key).read_text())
        return report
    return None


def has_results(output: Path) -> bool:
    """Return whether a chunk is done, or a process writes one or was killed while it did."""
    return any(next((output / part).glob("*"), None) is not None for part in (REPORTS, _PARTS))


class ChunkFiles:
    """Files of one chunk while they are written; several processes may write the same chunk, each in a directory.

    Parameters
    ----------
    output
        Directory of the results.
    key
        Name of the chunk.
    topics
        Paths of the topics to be written.
    recorded
        Configuration and metadata of the recording.
    """

    def __init__(self, output: Path, key: str, topics: tuple[str, ...], recorded: Recorded) -> None:
        self._output = output
        self._key = key
        self.topics = topics
        self._recorded = recorded
        (output / _PARTS).mkdir(exist_ok=True)
        self._parts = Path(tempfile.mkdtemp(prefix=f"{key}-", dir=output / _PARTS))
        self._days: dict[str, ParquetFormat] = {}
        self.rows: Counter[str] = Counter()

    def add(self, moment: Moment) -> None:
        """Write the messages of a moment, each to the files of its UTC day."""
        for topic, encoded in moment.messages:
            if topic.path in self.topics:
                message = decoded(topic.payload, encoded)
                self._day(utc_day(message.t_ns).isoformat()).put(topic, message, moment.now.utc_ns)
            self.rows[topic.path] += 1

    def _day(self, day: str) -> ParquetFormat:
        if day not in self._days:
            (self._parts / day).mkdir()
            # Two topics at least: the format then names the file of each after its topic.
            self._days[day] = ParquetFormat(self._parts / day / _NAME, ("", *self.topics), self._recorded)
            self._days[day].begin()
        return self._days[day]

    def close(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """Move the files to their final names, then write the report; return it with the sizes of the files.

        Other files of the chunk are removed: an earlier run wrote them, when the recording was shorter.
        """
        files: dict[str, int] = {}
        plate = quote(self._recorded.name, safe="")
        for day, output in self._days.items():
            for name, size_bytes in output.close().items():
                topic = Path(name).stem.removeprefix(f"{Path(_NAME).stem}-")
                place = self._output / topic / f"plate={plate}" / f"day={day}" / f"{self._key}.parquet"
                place.parent.mkdir(parents=True, exist_ok=True)
                os.replace(name, place)
                sync_directory(place.parent)
                files[str(place.relative_to(self._output))] = size_bytes
        for place in self._output.glob(f"*/plate={plate}/day=*/{self._key}.parquet"):
            if str(place.relative_to(self._output)) not in files:
                place.unlink(missing_ok=True)
        whole = {**report, "files": files}
        replace_file(report_path(self._output, self._key), json.dumps(whole).encode())
        for part in (self._output / _PARTS).glob(f"{self._key}-*"):  # also those of killed workers
            shutil.rmtree(part, ignore_errors=True)
        return whole

    def discard(self) -> None:
        """Remove the incomplete files."""
        for output in self._days.values():
            output.discard()
        shutil.rmtree(self._parts, ignore_errors=True)


def cannot_write(output: Path, error: OSError) -> OutputFailedError:
    """Return the error for results that cannot be written."""
    remedy = "repeat the command: it continues with the chunks that are not done"
    if error.errno in _NO_PLACE:
        remedy = "name a directory in which this user may make files"
    elif error.errno in (errno.ENOSPC, errno.EDQUOT):
        remedy = f"free space there, and {remedy}"
    return OutputFailedError(f"{output} cannot be written: {meaning_of(error)}; {remedy}")


_ID_STEP_NS = 10_000  # contact ids of a chunk count from its UTC in these steps, so that no two chunks share one


def decode_chunk(chunk: Chunk, job: Job) -> dict[str, Any]:
    """Decode a chunk, unless it is done; return its report.

    Raises
    ------
    OutputFailedError
        The results cannot be written.
    """
    done = report_of(chunk, job)
    if done is not None:
        return done
    gc.collect()  # the decoder of the chunk before, 100 MB and more, is part of reference cycles
    with local_file(chunk.path) as file, open_recording(file, job.plate) as recording:
        config = job.config(recording)
        span = span_of(file, chunk, config)
        metadata = table_metadata(Path(recording.path).name, config) | {"source_chunk": chunk.key}
        try:
            files = ChunkFiles(job.output, chunk.key, job.topics, Recorded(config, metadata))
            try:
                report: dict[str, Any] = {
                    "chunk": chunk.key,
                    "recording": recording.path,
                    "boundaries_bytes": span.boundaries_bytes,
                    "plate": config.name or config.plate.name,
                }
                if span.is_empty:
                    report |= _NO_FRAMES | {"damage": span.damage}
                else:
                    report |= _decode(chunk, recording, config, files, span)
                if report["damage"] is not None:
                    report["changed_ns"] = chunk.outline.changed_ns
                return files.close(report)
            except BaseException:
                files.discard()
                raise
        except OSError as error:
            done = read_report(job.output, chunk.key)  # another worker may have completed it, and removed these files
            if done is not None and chunk.is_described_by(done):
                return done
            raise cannot_write(job.output, error) from error


def report_of(chunk: Chunk, job: Job) -> dict[str, Any] | None:
    """Return the report of a chunk that is done; None if its recording has grown, or was damaged and changed since."""
    report = read_report(job.output, chunk.key)
    if report is None or not chunk.is_described_by(report):
        return None
    is_done = report["damage"] is None or (
        report["damage"] != STILL_WRITTEN and report.get("changed_ns") == chunk.outline.changed_ns
    )
    return report if is_done else None


_NO_FRAMES: dict[str, Any] = {"frames": 0, "rows": {}, "differences": 0, "damage": None, "refused": []}


def _decode(chunk: Chunk, recording: Recording, config: Config, files: ChunkFiles, span: Span) -> dict[str, Any]:
    begin, end = span.begin, span.end
    if begin is not None:
        recording.resume_at(chunk.outline.starts[chunk.number].begin_bytes, chunk.outline.channels)
    boot_id = recording.header.get("daemon_boot_id", UNKNOWN_BOOT_ID)
    last_contact_id = chunk.begin_ns // _ID_STEP_NS

    def make_decoding(settings: SurfaceSettings, client: SurfaceClient[Any]) -> SurfaceDecoding[Any]:
        return SequentialDecoding(replace(settings, last_contact_id=last_contact_id, cold_at_rest=True), client)

    replaying = RecordingReplay(recording, config, boot_id, make_decoding)
    for moment in replaying.moments():
        if end is not None and moment.now.monotonic_ns >= end.monotonic_ns:
            break
        if begin is None or moment.now.monotonic_ns >= begin.monotonic_ns:
            files.add(moment)
    return {
        "frames": files.rows[DECODED.path] + files.rows[FORCES.path],
        "rows": {topic: rows for topic, rows in files.rows.items() if topic in files.topics},
        "differences": replaying.differences,
        "damage": replaying.damage,
        "refused": list(replaying.refused),
    }
