"""A disk that fills up and is emptied again, with the spool and the recordings of a simulated daemon on it."""

import asyncio
import logging
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from unittest.mock import patch

from resonator_daemon.config import Config
from resonator_daemon.config.text import plate_text, settings_text
from resonator_daemon.plate import Plate
from resonator_daemon.publishing import event_queue
from resonator_daemon.recording.file_series import Series
from resonator_daemon.recording.reader import Origin, open_recording
from resonator_daemon.recording.recorder import Recorder, RecorderTimes
from resonator_daemon.session import link_events as wire

_DISK_BYTES: Final = 32 << 20
_TIMES: Final = RecorderTimes(batch_s=0.1, flush_s=0.0, retry_s=0.0)  # a simulated day takes about a second
_RETRY_S: Final = 0.01
_DONE_S: Final = 30.0
_OF_THE_FILE: Final = (wire.SnapshotTaken, wire.Skipped)  # not of the link


class SimulatedDisk:
    """A small file system; without root it is a directory, which is never full.

    `reports` are what spool and recorder logged as warnings since the disk was filled.
    """

    def __init__(self, path: Path, *, can_fill: bool) -> None:
        self.path, self.can_fill = path, can_fill
        self.reports: list[str] = []
        self._filler = path / "filler"

    def fill(self) -> None:
        """Fill the disk to the last byte."""
        self.reports.clear()
        with self._filler.open("wb", buffering=0) as file:
            for block in (65536, 4096, 1):
                try:
                    while True:
                        file.write(bytes(block))
                except OSError:
                    continue

    def empty(self) -> None:
        self._filler.unlink()


@contextmanager
def small_disk(folder: Path) -> Iterator[SimulatedDisk]:
    """Mount the disk as root; until the end, a disk that failed is tried again after milliseconds."""
    path = folder / "disk"
    path.mkdir()
    disk = SimulatedDisk(path, can_fill=os.geteuid() == 0)
    if disk.can_fill:
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "tmpfs", str(path)], check=True)
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: disk.reports.append(f"spool: {record.getMessage()}")  # type: ignore[method-assign]
    logger = logging.getLogger(event_queue.__name__)
    logger.addHandler(handler)
    try:
        with patch.object(event_queue, "RETRY_S", _RETRY_S):
            yield disk
    finally:
        logger.removeHandler(handler)
        if disk.can_fill:
            subprocess.run(["umount", str(path)], check=True)


class RunRecorder:
    """Recordings of one run of a daemon; each event on the link is in one of their files, or counted as missing."""

    def __init__(self, config: Config, plate: Plate, boot_id: str, disk: SimulatedDisk) -> None:
        self._directory = disk.path / "recordings"
        origin = Origin(plate, str(config.link), config.name, boot_id, None, plate_text(plate), settings_text(config))

        def log_line(level: int, text: str) -> None:
            if level >= logging.WARNING:
                disk.reports.append(f"recorder: {text}")

        series = Series(self._directory, "year", resumes=True)
        self._recorder = Recorder(series, origin, log_line=log_line, times=_TIMES)
        self._events = 0

    @property
    def failed(self) -> bool:
        return self._recorder.failure is not None

    def put(self, event: wire.WireEvent) -> None:
        self._recorder.put(event)
        self._events += not isinstance(event, _OF_THE_FILE)

    def end(self) -> str | None:
        """Close the recordings, count their events and remove them; return what does not balance."""
        self._recorder.close()
        recorded = 0
        for path in sorted(self._directory.iterdir()):
            with open_recording(str(path)) as recording:
                recorded += sum(not isinstance(event, _OF_THE_FILE) for event in recording.events())
            path.unlink()
        missing = self._recorder.counts.events_missing
        if recorded + missing == self._events:
            return None
        return f"{recorded} events recorded, {missing} missing, asked {self._events}"


async def until(reached: Callable[[], bool]) -> None:
    """Wait for threads that write.

    Raises
    ------
    TimeoutError
        It is not reached within 30 s.
    """
    async with asyncio.timeout(_DONE_S):
        while not reached():  # noqa: ASYNC110 - other threads reach it
            await asyncio.sleep(0.002)
