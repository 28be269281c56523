"""Load of this computer: what a process uses, how long it waits, and whether the computer is too busy for it."""

import math
import resource
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import psutil

from resonator_daemon.base.reasons import Reason, ReasonCode

BUSY_PERCENT: Final = 65.0  # eight busy programs on two processors: 70 to 95; `resonatord demo` alone on two: 41
_AT_EASE_PERCENT: Final = 57.0
_MEMORY_NS: Final = 1_200_000_000
_SAMPLE_NS: Final = 50_000_000

REMEDY: Final = (
    "give the daemon precedence (CPUWeight of its unit, or nice), decode on another computer, lower "
    "counter.frame_rate_hz of the plate, or use another computer"
)


class LoadSample(NamedTuple):
    """Lack of processors since the sample before.

    Attributes
    ----------
    waited_percent
        Share of the time in which threads of this process could run and waited for a processor.
    pressure_percent
        Share of the time in which any thread of the computer waited for a processor.
    """

    waited_percent: int = 0
    pressure_percent: int = 0


NO_LOAD: Final = LoadSample()


class LoadMeter:
    """Measures the load by what Linux counts for threads (`schedstat`) and for the computer (`pressure/cpu`).

    If Linux counts only one of them, it is used for both.
    """

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._threads, self._pressure = proc / "self/task", proc / "pressure/cpu"
        self._last = NO_LOAD
        self._before = time.monotonic_ns(), *self._waited_and_used_ns(), self._pressure_ns()

    def sample(self) -> LoadSample:
        """Return the load since the sample before; the same as before if that was less than 50 ms ago."""
        now_ns = time.monotonic_ns()
        elapsed_ns = now_ns - self._before[0]
        if elapsed_ns >= _SAMPLE_NS:
            now = now_ns, *self._waited_and_used_ns(), self._pressure_ns()
            _, waited_ns, used_ns, pressure_ns = (max(new - old, 0) for new, old in zip(now, self._before, strict=True))
            waited = 100 * waited_ns // max(waited_ns + used_ns, 1)
            pressure = min(100 * pressure_ns // elapsed_ns, 100) if now[3] else waited
            self._last = LoadSample(waited if now[2] else pressure, pressure)
            self._before = now
        return self._last

    def _pressure_ns(self) -> int:
        try:
            return 1000 * int(self._pressure.read_bytes().split(None, 5)[4].removeprefix(b"total="))
        except (OSError, IndexError, ValueError):  # this kernel or container has none
            return 0

    def _waited_and_used_ns(self) -> tuple[int, int]:
        waited_ns = used_ns = 0
        with suppress(OSError):  # no free file descriptor
            for file in self._threads.glob("*/schedstat"):
                with suppress(OSError, ValueError):  # a thread that has ended, or no statistics
                    used, waited, _ = file.read_bytes().split()
                    waited_ns += int(waited)
                    used_ns += int(used)
        return waited_ns, used_ns


def busy_reason(sample: LoadSample) -> Reason:
    """Return the reason of a busy computer, with the share of time that was lacking."""
    text = f"this computer is busy: the program waited for a processor {min(sample)} % of the time that it could run"
    return Reason(ReasonCode.COMPUTER_BUSY, text)


class HostLoad(NamedTuple):
    """Mean load of about two seconds, and whether the computer is busy by it; all depends on the samples alone.

    The computer is busy from 65 % on, until the mean is below 57 %. Of the two shares of a sample, the lower one
    counts: a process that precedes others does not wait, and one that does little may wait long by chance.

    Attributes
    ----------
    busy
        Reason of a busy computer; None if it is not.
    """

    monotonic_ns: int = 0
    lacking_percent: float = 0.0
    busy: Reason | None = None

    def updated(self, monotonic_ns: int, sample: LoadSample) -> "HostLoad":
        """Return the load with a sample that ends at a time."""
        elapsed_ns = monotonic_ns - self.monotonic_ns
        mean = self.lacking_percent + (min(sample) - self.lacking_percent) * elapsed_ns / (_MEMORY_NS + elapsed_ns)
        busy = self.busy
        if mean >= BUSY_PERCENT:
            busy = busy or busy_reason(sample)
        elif mean < _AT_EASE_PERCENT:
            busy = None
        return HostLoad(monotonic_ns, mean, busy)


class ResourceUse(NamedTuple):
    """What a process uses; `cpu_percent` is of one core, since the last call of `use`."""

    cpu_percent: float
    rss_mb: float
    threads: int
    file_descriptors: int


class ProcessUsage:
    """Processor time, memory and threads of a process; by default of this one."""

    def __init__(self, pid: int | None = None) -> None:
        self._process = psutil.Process(pid)
        self._last = self._now()  # and begin the interval of the processor time

    @property
    def pid(self) -> int:
        return self._process.pid

    def use(self) -> ResourceUse:
        """Return what it uses now.

        The system reports it in files. If none can be opened, or the process has ended, `cpu_percent` is NaN,
        `file_descriptors` the limit, and the rest as it was.
        """
        try:
            self._last = self._now()
        except (OSError, psutil.Error):
            most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            return self._last._replace(cpu_percent=math.nan, file_descriptors=most)
        return self._last

    def _now(self) -> ResourceUse:
        rss_mb = float(self._process.memory_info().rss) * 1e-6
        return ResourceUse(self._process.cpu_percent(), rss_mb, self._process.num_threads(), self._process.num_fds())
