"""Decoding of one chunk, in any process: the result depends on the recording and the job only."""

import gc
from dataclasses import replace
from functools import partial
from typing import Any

from resonator_daemon.board.config import Config
from resonator_daemon.board.recording.reader import STILL_WRITTEN, Recording, open_recording
from resonator_daemon.extensions.fleet.changes import STORED_TOPICS, Changes
from resonator_daemon.extensions.fleet.chunk_files import ChunkFiles, cannot_write, read_report
from resonator_daemon.extensions.fleet.chunks import Chunk, Job, Span, span_of
from resonator_daemon.measure.sensors.surface_decoding import SequentialDecoding, SurfaceClient, SurfaceDecoding
from resonator_daemon.measure.sensors.surface_worker import SurfaceSettings
from resonator_daemon.mqtt.topics import DECODED, FORCES
from resonator_daemon.tools.export.output import Recorded
from resonator_daemon.tools.export.run import table_metadata
from resonator_daemon.tools.replay.recorded_pipeline import UNKNOWN_BOOT_ID, RecordingReplay

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
    with open_recording(str(chunk.path), job.plate) as recording:
        config = job.config(recording)
        span = span_of(chunk, config)
        metadata = table_metadata(chunk.path.name, config) | {"source_chunk": chunk.key}
        try:
            files = ChunkFiles(job.output, chunk.key, job.topics, Recorded(config, metadata))
            try:
                report: dict[str, Any] = {
                    "chunk": chunk.key,
                    "recording": str(chunk.path),
                    "boundaries_bytes": span.boundaries_bytes,
                    "plate": config.name or config.plate.name,
                }
                if span.is_empty:
                    report |= _NO_FRAMES | {"damage": span.damage}
                else:
                    changes = Changes(span.begin and span.begin.utc_ns, span.end and span.end.utc_ns)
                    report |= _decode(chunk, recording, config, files, changes, span)
                if report["damage"] is not None:
                    report["changed_ns"] = chunk.changed_ns
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
        report["damage"] != STILL_WRITTEN and report.get("changed_ns") == chunk.changed_ns
    )
    return report if is_done else None


_NO_FRAMES: dict[str, Any] = {"frames": 0, "rows": {}, "differences": 0, "damage": None, "refused": [], "changes": {}}


def _decode(
    chunk: Chunk, recording: Recording, config: Config, files: ChunkFiles, changes: Changes, span: Span
) -> dict[str, Any]:
    begin, end = span.begin, span.end
    if begin is not None:
        recording.resume_at(chunk.starts[chunk.number].begin_bytes, chunk.channels)
    for topic in STORED_TOPICS:
        recording.receivers[topic] = partial(changes.add_stored, topic)
    boot_id = recording.header.get("daemon_boot_id", UNKNOWN_BOOT_ID)
    last_contact_id = chunk.begin_ns // _ID_STEP_NS

    def make_decoding(settings: SurfaceSettings, client: SurfaceClient[Any]) -> SurfaceDecoding[Any]:
        return SequentialDecoding(replace(settings, last_contact_id=last_contact_id, cold_at_rest=True), client)

    replaying = RecordingReplay(recording, config, boot_id, make_decoding)
    for moment in replaying.moments():
        if end is not None and moment.now.monotonic_ns >= end.monotonic_ns:
            break
        if begin is None or moment.now.monotonic_ns >= begin.monotonic_ns:
            for message in files.add(moment):
                changes.add_decoded(message)
    return {
        "frames": files.rows[DECODED.path] + files.rows[FORCES.path],
        "rows": {topic: rows for topic, rows in files.rows.items() if topic in files.topics},
        "differences": replaying.differences,
        "damage": replaying.damage,
        "refused": list(replaying.refused),
        "changes": changes.numbers(),
    }
