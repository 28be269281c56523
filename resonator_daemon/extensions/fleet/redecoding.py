"""One run over many recordings: plan, workers, progress, summary."""

import hashlib
import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Any, Final

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

from resonator_daemon.base.errors import NoRecordingError, UsageError
from resonator_daemon.base.host.files import replace_file
from resonator_daemon.base.toml import nearest
from resonator_daemon.board.recording.reader import damage_in_words
from resonator_daemon.extensions.fleet.chunk_decoding import REPORTS, cannot_write, decode_chunk, has_results, report_of
from resonator_daemon.extensions.fleet.chunks import Chunk, Job, plan
from resonator_daemon.mqtt.topics import SIGNALS, STATE_LINK, STATE_SENSOR
from resonator_daemon.tools.export.tables import WITH_TABLE

TOPICS: Final = tuple(path for path in WITH_TABLE if path not in (SIGNALS.path, STATE_LINK.path, STATE_SENSOR.path))
"""Paths of the topics that can be decoded again."""
_SETTINGS_FILE: Final = "settings.json"


def chosen_topics(text: str | None) -> tuple[str, ...]:
    """Return the topics in a comma-separated text, None: all; UsageError for a topic that cannot be decoded again."""
    topics = TOPICS if text is None else tuple(dict.fromkeys(text.split(",")))
    for topic in topics:
        if topic not in TOPICS:
            raise UsageError(f"--topics: got {topic!r}; {nearest(topic, TOPICS)}")
    return topics


def decode_all(
    paths: Sequence[str], job: Job, scheduler: str | None, workers: int, *, show_progress: bool
) -> tuple[dict[str, Any], list[str]]:
    """Decode recordings; return the summary by the keys of `--json`, and a sentence for each problem.

    Raises
    ------
    NoRecordingError
        None of the files can be decoded.
    UsageError
        The directory contains results of other settings.
    UserError
        A recording lacks settings, the results cannot be written, or the cluster cannot be used.
    """
    chunks, refused = plan(paths, job)
    if not chunks:
        raise NoRecordingError(*refused.values())
    try:
        _claim(job)
    except OSError as error:
        raise cannot_write(job.output, error) from error
    reports = {chunk.key: report for chunk in chunks if (report := report_of(chunk, job)) is not None}
    waiting = [chunk for chunk in chunks if chunk.key not in reports]
    skipped = len(reports)
    with _bar(show_progress) as bar:
        task = bar.add_task("", total=sum(chunk.length_bytes for chunk in chunks))
        bar.advance(task, sum(chunk.length_bytes for chunk in chunks if chunk.key in reports))
        for report in _reports(waiting, job, scheduler, workers):
            reports[report["chunk"]] = report
            bar.advance(task, next(chunk.length_bytes for chunk in waiting if chunk.key == report["chunk"]))
    return _summary(list(reports.values()), skipped, refused, job)


def _reports(chunks: list[Chunk], job: Job, scheduler: str | None, workers: int) -> Iterator[dict[str, Any]]:
    if scheduler is None and workers == 1:
        return (decode_chunk(chunk, job) for chunk in chunks)
    from resonator_daemon.extensions.fleet.cluster import decode_on_cluster

    return decode_on_cluster(chunks, job, scheduler, workers) if chunks else iter(())


def _claim(job: Job) -> None:
    """Write the settings into the directory; UsageError if it contains results of other settings.

    A run that has not begun a chunk, as without a scheduler, leaves settings that others may replace.
    """
    texts = [job.plate_text, job.settings_text, job.chunk_s, job.topics, version("resonatord")]
    settings = {
        "settings_sha256": hashlib.sha256(json.dumps(texts).encode()).hexdigest(),
        "resonatord_version": version("resonatord"),
        "topics": job.topics,
        "chunk_seconds": job.chunk_s,
        "plate": job.plate_text,
        "settings": job.settings_text,
    }
    (job.output / REPORTS).mkdir(parents=True, exist_ok=True)
    path = job.output / _SETTINGS_FILE
    if not path.exists() or not has_results(job.output):
        replace_file(path, json.dumps(settings, indent=2).encode())
    elif json.loads(path.read_text()).get("settings_sha256") != settings["settings_sha256"]:
        raise UsageError(
            f"{job.output} contains results of another plate file, or of other settings, topics, --chunk-seconds or "
            f"version (those in {path}); choose another --output"
        )


def _bar(shown: bool) -> Progress:
    console = Console(stderr=True, highlight=False, markup=False)
    columns = (TextColumn("decoding"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True, disable=not (shown and sys.stderr.isatty()))


def _summary(
    reports: list[dict[str, Any]], skipped: int, refused: dict[str, str], job: Job
) -> tuple[dict[str, Any], list[str]]:
    rows = Counter(dict.fromkeys(job.topics, 0))
    wrong = list(refused.values())
    for report in reports:
        rows.update(report["rows"])
        name = report["recording"]
        if report["damage"] is not None:
            wrong.append(f"{name}: {damage_in_words(report['damage'], 'decoded')}")
        if report["differences"]:
            wrong.append(f"{name}: its replay differs from what is recorded in {report['differences']} places")
        if report["refused"]:
            wrong.append(f"{name}: the board was refused: {'; '.join(report['refused'])}")
    summary = {
        "output": str(job.output),
        "recordings": len({report["chunk"].rpartition("-")[0] for report in reports}),  # names may be equal
        "plates": sorted({report["plate"] for report in reports}),
        "chunks": len(reports),
        "chunks_done_before": skipped,
        "frames": sum(report["frames"] for report in reports),
        "rows": dict(sorted(rows.items())),
        "files": sum(len(report["files"]) for report in reports),
        "file_bytes": sum(sum(report["files"].values()) for report in reports),
    }
    return summary, list(dict.fromkeys(wrong))
