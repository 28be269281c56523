"""Emulated boards in a thread of the test's own process."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from simulators.emulator import Emulator, EmulatorOptions


def balanced_report(emulator: Emulator) -> dict[str, Any]:
    """Return the emulator's report, whose counts of frames agree."""
    report = emulator.report()
    assert report["frames_made"] == report["frames_sent"] + report["frames_dropped"] + report["frames_unsent"]
    assert sum(report["dropped_by_cause"].values()) == report["frames_dropped"]
    assert min(report["dropped_by_cause"].values()) >= 0
    return report


@contextmanager
def emulated(options: EmulatorOptions) -> Iterator[Emulator]:
    emulator = Emulator(options)
    thread = threading.Thread(target=emulator.run)
    thread.start()
    try:
        yield emulator
    finally:
        emulator.stop()
        thread.join()
