"""Processor time of the whole computer during a run, and the process outside of the run that used most of it."""

import time
from collections.abc import Collection

import psutil


class HostLoad:
    """Processor time from the construction to `stop`; processes that start or end in between are in the sum alone.

    Attributes
    ----------
    used_s
        Processor time of each process, in seconds; valid after `stop`.
    """

    def __init__(self) -> None:
        self.used_s = {process: _cpu_s(process) for process in psutil.process_iter()}
        self._busy_s = _busy_s()
        self._started_s = time.monotonic()
        self._ended_s = self._started_s

    def stop(self) -> None:
        """End the measurement."""
        self._ended_s = time.monotonic()
        self._busy_s = _busy_s() - self._busy_s
        self.used_s = {process: _cpu_s(process) - before_s for process, before_s in self.used_s.items()}

    def in_words(self, own_cpu_s: float, own_pids: Collection[int]) -> str:
        """Return a sentence with the processes that kept the computer busy, given those of the run and their time."""
        seconds = max(self._ended_s - self._started_s, 1e-9)
        cores, own = psutil.cpu_count() or 1, own_cpu_s / seconds
        others = max(self._busy_s / seconds - own, 0.0)
        words = f"processor cores used: {own:.2f} of {cores} by these processes, {others:.2f} by other processes"
        foreign = {process: used_s for process, used_s in self.used_s.items() if process.pid not in own_pids}
        if foreign:
            process = max(foreign, key=lambda process: foreign[process])
            if (used := foreign[process] / seconds) >= others / 4 and used >= 0.05:
                words += f", of which {used:.2f} by {_name(process)} (process {process.pid})"
        return words


def _busy_s() -> float:
    times = psutil.cpu_times()
    return float(sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0))


def _cpu_s(process: psutil.Process) -> float:
    try:
        times = process.cpu_times()
    except psutil.Error:
        return 0.0
    return float(times.user + times.system)


def _name(process: psutil.Process) -> str:
    try:
        return str(process.name())
    except psutil.Error:
        return "one that has ended"
