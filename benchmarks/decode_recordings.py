"""Cost of decoding recordings again: frames a second by workers, and memory of each worker by length.

Run as `python benchmarks/decode_recordings.py --minutes 2 4 --workers 1 2`; needs the extra fleet, and about 0.9 GB of
disk a minute. It records skin32 in simulated time, pressed 80 % of it (scenario press-and-shear). All figures are those
of the whole command, with the start and the end of its processes.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import psutil
from simulated_recording import record

from resonator_daemon.plate import load_plate

_LOOK_S = 1.0  # finding all child processes takes some milliseconds of a core, which the workers need
_COMMAND = (sys.executable, "-m", "resonator_daemon", "decode-recordings")


class Run(NamedTuple):
    """Cost of one run; `worker_mb` is the peak of the largest process."""

    seconds: float
    processor_s: float
    frames: int
    worker_mb: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plate", default="skin32")
    parser.add_argument("--minutes", type=float, nargs="+", default=[2.0, 4.0])
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--chunk-seconds", type=float, default=15.0)
    parser.add_argument(
        "--folder", type=Path, help="directory of the recordings, which are kept and reused (default: temporary)"
    )
    options = parser.parse_args()
    print("minutes  workers  seconds   frames  frames/s  processor ms/frame  peak MB of a process", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        for minutes in options.minutes:
            path = folder / f"{options.plate}-{minutes:g}.mcap"
            if not path.exists():
                record(path, load_plate(options.plate), 60.0 * minutes)
            for workers in options.workers:
                with tempfile.TemporaryDirectory(dir=temporary) as output:
                    took = run(path, Path(output), workers, options.chunk_seconds)
                print(
                    f"{minutes:7g} {workers:8} {took.seconds:8.1f} {took.frames:8} {took.frames / took.seconds:9.1f} "
                    f"{1e3 * took.processor_s / took.frames:19.1f} "
                    f"{took.worker_mb:21.0f}",
                    flush=True,
                )


def run(path: Path, output: Path, workers: int, chunk_s: float) -> Run:
    """Decode a recording in processes of their own."""
    command = [*_COMMAND, str(path), "--output", str(output), "--workers", str(workers), "--json"]
    before_s, begun_s, peak = processor_s(), time.monotonic(), 0
    process = subprocess.Popen([*command, "--chunk-seconds", str(chunk_s)], stdout=subprocess.PIPE, text=True)
    while process.returncode is None:
        peak = max([peak, *rss_bytes(process.pid)])
        with suppress(subprocess.TimeoutExpired):
            process.wait(_LOOK_S)
    took_s = time.monotonic() - begun_s
    assert process.stdout is not None  # noqa: S101 - it is a pipe
    result = json.loads(process.stdout.read())
    return Run(took_s, processor_s() - before_s, result["frames"], peak / 1e6)


def processor_s() -> float:
    """Return the processor time of all child processes that have ended, and of theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def rss_bytes(pid: int) -> list[int]:
    """Return the memory of a process and of each of its children."""
    try:
        root = psutil.Process(pid)
        return [process.memory_info().rss for process in (root, *root.children(recursive=True))]
    except psutil.NoSuchProcess:
        return []


if __name__ == "__main__":
    main()
