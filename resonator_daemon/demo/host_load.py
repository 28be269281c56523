"""How busy this computer is during a run, and how long the processes of the run waited for a processor."""

import time
from collections.abc import Collection
from pathlib import Path
from typing import Final

import psutil

OVERLOADED_SHARE: Final = (
    0.5  # of used and waited time; the demo waits for 0.41 on two processors that run nothing else
)


class HostLoad:
    """Processor time from the construction to `stop`; processes that start or end in between are in the sum alone.

    Attributes
    ----------
    used_s
        Processor time of each process, in seconds; valid after `stop`.
    """

    def __init__(self) -> None:
        self.used_s = {process: _cpu_s(process) for process in psutil.process_iter()}
        self._waited_s = {process: _waited_s(process) for process in self.used_s}
        self._busy_s = _busy_s()
        self._started_s = time.monotonic()
        self._ended_s = self._started_s

    def stop(self) -> None:
        """End the measurement."""
        self._ended_s = time.monotonic()
        self._busy_s = _busy_s() - self._busy_s
        self.used_s = {process: _cpu_s(process) - before_s for process, before_s in self.used_s.items()}
        self._waited_s = {process: _waited_s(process) - before_s for process, before_s in self._waited_s.items()}

    def overloaded(self, own_cpu_s: float, own_pids: Collection[int]) -> bool:
        """Whether the processes of the run waited longer for a processor than they ran."""
        waited_s = self._own_wait_s(own_pids)
        return waited_s > OVERLOADED_SHARE * (own_cpu_s + waited_s)

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
        return f"{words}; lack of a free core delayed these processes by {self._own_wait_s(own_pids):.1f} s in sum"

    def _own_wait_s(self, own_pids: Collection[int]) -> float:
        return max(sum(waited_s for process, waited_s in self._waited_s.items() if process.pid in own_pids), 0.0)


def _busy_s() -> float:
    times = psutil.cpu_times()
    return float(sum(times) - times.idle - getattr(times, "iowait", 0.0) - getattr(times, "guest", 0.0))


def _cpu_s(process: psutil.Process) -> float:
    try:
        times = process.cpu_times()
    except psutil.Error:
        return 0.0
    return float(times.user + times.system)


def _waited_s(process: psutil.Process) -> float:
    """Return how long the threads of a process were ready to run without a processor; 0 where Linux does not count."""
    waited_ns = 0
    for file in Path(f"/proc/{process.pid}/task").glob("*/schedstat"):
        try:
            waited_ns += int(file.read_text().split()[1])
        except (OSError, IndexError, ValueError):  # a thread that has ended, or no statistics
            continue
    return 1e-9 * waited_ns


def _name(process: psutil.Process) -> str:
    try:
        return str(process.name())
    except psutil.Error:
        return "one that has ended"
