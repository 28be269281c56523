"""Load of this computer: resources of a process, its waiting time for processors, and whether the computer is busy."""

import math
import resource
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import psutil

from resonator_daemon.base.reasons import Reason, ReasonCode

BUSY_PERCENT: Final = 65.0  # eight busy programs on two processors: 70 to 95; `resonatord demo` alone on two: 41
_NOT_BUSY_PERCENT: Final = 57.0
_TIME_CONSTANT_NS: Final = 1_200_000_000
_SAMPLE_NS: Final = 50_000_000  # shorter than the shortest frame timeout, so that a sample lies within it
_THREADS_NS: Final = 250_000_000  # a file for each thread takes 0.3 ms, the one of the computer a tenth

REMEDY: Final = (
    "give the daemon precedence (CPUWeight of its unit, or nice), decode on another computer, lower "
    "counter.frame_rate_hz of the plate, or use another computer"
)


class LoadSample(NamedTuple):
    """Waiting time for processors since the previous sample.

    Attributes
    ----------
    waited_percent
        Of the time in which threads of this process could run, the share in which they waited for a processor.
    pressure_percent
        Share of the time in which any thread of the computer waited for a processor.
    """

    waited_percent: int = 0
    pressure_percent: int = 0


NO_LOAD: Final = LoadSample()


class LoadMeter:
    """Measures the load from counters of Linux: of threads (`schedstat`) and of the computer (`pressure/cpu`).

    If only one of them exists, its share is used for both.
    """

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._threads, self._pressure = proc / "self/task", proc / "pressure/cpu"
        self._last = NO_LOAD
        self._pressure_before = time.monotonic_ns(), self._pressure_ns()
        self._threads_before = self._pressure_before[0], *self._waited_and_used_ns()

    def sample(self) -> LoadSample:
        """Return the load since the previous sample; if that is less than 50 ms old, the previous sample.

        Counters of threads are read every 250 ms; without the computer's counter, with each sample.
        """
        now_ns, (before_ns, pressure_before_ns) = time.monotonic_ns(), self._pressure_before
        if now_ns - before_ns < _SAMPLE_NS:
            return self._last
        self._pressure_before = now_ns, self._pressure_ns()
        pressure_ns = max(self._pressure_before[1] - pressure_before_ns, 0)
        waited, pressure = self._last.waited_percent, min(100 * pressure_ns // (now_ns - before_ns), 100)
        threads_ns, waited_before_ns, used_before_ns = self._threads_before
        has_pressure = self._pressure_before[1] > 0
        if now_ns - threads_ns >= _THREADS_NS or not has_pressure:
            waited_ns, used_ns = self._waited_and_used_ns()
            self._threads_before = now_ns, waited_ns, used_ns
            waited_ns, ran_ns = max(waited_ns - waited_before_ns, 0), max(used_ns - used_before_ns, 0)
            waited = 100 * waited_ns // max(waited_ns + ran_ns, 1)
        has_threads = self._threads_before[2] > 0
        self._last = LoadSample(waited if has_threads else pressure, pressure if has_pressure else waited)
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
    """Return the reason for a busy computer, with the share of waiting time."""
    text = f"this computer is busy: the program waited for a processor {min(sample)} % of the time that it could run"
    return Reason(ReasonCode.COMPUTER_BUSY, text)


class HostLoad(NamedTuple):
    """Mean load over about two seconds, and whether the computer is busy; both depend on the samples alone.

    The computer becomes busy at a mean of 65 %, and stays busy until the mean is below 57 %. The lower share of a
    sample counts: a process with priority does not wait, and a process that is mostly idle may wait long by chance.

    Attributes
    ----------
    busy
        Reason for a busy computer; None if it is not busy.
    """

    monotonic_ns: int = 0
    processor_wait_percent: float = 0.0
    busy: Reason | None = None

    def updated(self, monotonic_ns: int, sample: LoadSample) -> "HostLoad":
        """Return the load after one more sample, which ends at `monotonic_ns`."""
        elapsed_ns, busy = monotonic_ns - self.monotonic_ns, self.busy
        mean, weight = self.processor_wait_percent, elapsed_ns / (_TIME_CONSTANT_NS + elapsed_ns)
        mean += (min(sample) - mean) * weight
        if mean >= BUSY_PERCENT:
            busy = busy or busy_reason(sample)
        elif mean < _NOT_BUSY_PERCENT:
            busy = None
        return HostLoad(monotonic_ns, mean, busy)


class ResourceUse(NamedTuple):
    """Resources of a process; `cpu_percent` is of one core, since the last call of `measure`."""

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

    def measure(self) -> ResourceUse:
        """Return the present use of resources.

        If no file descriptor is free, or the process has ended, `cpu_percent` is NaN and `file_descriptors` is the
        limit. The rest is then as at the last call.
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
