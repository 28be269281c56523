"""What whole processes cost: demo, daemons and emulators against another checkout in turns, replay, decoding of files.

`system_cost.py demo` prints the cores of `make demo` by part, `daemon --baseline DIR` those of daemon and emulator of
this checkout and of another one in turns, the wakes of their threads and the share of frames that became messages,
`replay` the speed of a replay, `decode-recordings` frames a second by workers. A baseline needs a `.venv` of its own.
"""

import argparse
import json
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

import psutil
from parts import COMMAND, ROOT, child, emulated_board, processor_s, running
from simulated_recording import record

from resonator_daemon.base.plate import load_plate
from resonator_daemon.tools.replay.recorded_pipeline import open_replay

SETTLE_S = 3.0
LOOK_S = 1.0  # finding all child processes takes some milliseconds of a core, which the workers need


def demo(options: argparse.Namespace) -> int:
    command = (*COMMAND, "demo", "--headless", "--seconds", str(options.seconds), "--json")
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if not run.stdout:
        return run.returncode
    result = json.loads(run.stdout)
    for part, percent in sorted(result["cpu_percent_by_part"].items(), key=lambda item: -item[1]):
        print(f"{part:30} {percent:8.1f} % of a core")
    print(f"{'all':30} {100 * result['cores']:8.1f} % of a core")
    for name, plate in result["plates"].items():
        print(name, ", ".join(f"{key} {value}" for key, value in plate.items() if value is not None), sep=": ")
    return run.returncode


def at_rate(plate: str, rate_hz: float | None, folder: Path) -> str:
    """Return a shipped plate, with a rate as a file."""
    if rate_hz is None:
        return plate
    text = (ROOT / "resonator_daemon/base/plates" / f"{plate}.toml").read_text()
    path = folder / f"{plate}.toml"
    path.write_text(re.sub("(?m)^frame_rate_hz = .*", f"frame_rate_hz = {rate_hz:g}", text))
    return str(path)


def waits(pid: int) -> dict[int, int]:
    """Return how often each thread of a process has waited so far: so often it was woken."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(OSError):
            found[int(task.name)] = int(
                (task / "status").read_text().partition("\nvoluntary_ctxt_switches:")[2].split()[0]
            )
    return found


def measure(checkout: Path, plate: str, result: str, scenario: tuple[str, ...], seconds: float) -> dict[str, float]:
    """Run a system of a checkout; return its figures."""
    command = (str(checkout / ".venv" / "bin" / "resonatord"),)
    with running(plate, *scenario, command=command) as system:
        time.sleep(SETTLE_S)
        pids = {"daemon, %": system.daemon.pid, "emulator, %": system.board.pid, "broker, %": system.broker_pid}
        messages, woken, began_s = system.counts[result], waits(system.daemon.pid), time.monotonic()
        before = {name: processor_s(pid) for name, pid in pids.items()}
        time.sleep(seconds)
        passed_s = time.monotonic() - began_s
        figures = {name: 100.0 * (processor_s(pid) - before[name]) / passed_s for name, pid in pids.items()}
        rates = {
            thread: (count - woken.get(thread, 0)) / passed_s for thread, count in waits(system.daemon.pid).items()
        }
        figures["wakes of the reader / s"] = max(rate for thread, rate in rates.items() if thread != system.daemon.pid)
        figures["of the main thread / s"] = rates[system.daemon.pid]
        figures[f"{result} / s"] = (system.counts[result] - messages) / passed_s
        lost = json.loads(system.last["health"])["lost"]  # without zeros
        figures["skipped since the start"] = lost.pop("skipped_late", 0)
        figures["frames lost"] = sum(lost.values())
        return figures


def daemon(options: argparse.Namespace) -> int:
    """Print the median of some turns for each figure, and the ratio to the baseline."""
    checkouts = [ROOT, *([options.baseline.absolute()] if options.baseline else [])]
    for plate in options.plate or ("quartz16", "skin32"):
        skin = load_plate(plate).skin is not None
        scenario, result = (("--scenario", "press-and-shear"), "decoded") if skin else ((), "forces")
        turns: dict[str, list[list[float]]] = defaultdict(lambda: [[] for _ in checkouts])
        with tempfile.TemporaryDirectory() as folder:
            file = at_rate(plate, options.rate, Path(folder))
            for _ in range(options.turns):
                for number, checkout in enumerate(checkouts):
                    for name, value in measure(checkout, file, result, scenario, options.seconds).items():
                        turns[name][number].append(value)
        print(f"{plate:26}{'this':>10}" + f"{'baseline':>10}{'ratio':>8}" * (len(checkouts) - 1))
        for name, values in turns.items():
            medians = [statistics.median(each) for each in values]
            ratio = f"{medians[0] / medians[1]:8.2f}" if len(medians) > 1 and medians[1] else ""
            print(f"  {name:24}" + "".join(f"{each:10.1f}" for each in medians) + ratio, flush=True)
    return 0


def record_quartz(folder: Path, seconds: float) -> Path:
    """Record an emulated quartz16 with touches at full rate."""
    output, config = folder / "run.mcap", folder / "record.toml"
    with emulated_board("quartz16", folder, "--scenario", "real") as board:
        config.write_text(f'plate = "quartz16"\nlink = "{board.link}"\n')
        asked = ("record", "--config", str(config), "--output", str(output), "--seconds", str(seconds))
        subprocess.run((*COMMAND, *asked), check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return output


def replay(options: argparse.Namespace) -> int:
    """Print the speed by processor time on one core, the best of three."""
    with tempfile.TemporaryDirectory() as folder:
        path = options.file or record_quartz(Path(folder), options.seconds)
        speeds = []
        for _ in range(3):
            began_s, times_ns = time.process_time(), list[int]()
            with open_replay(path) as replaying:
                for moment in replaying.moments():
                    times_ns = [*times_ns[:1], moment.now.monotonic_ns]
                frames, differences = replaying.counters.frames, replaying.differences
            speeds.append(1e-9 * (times_ns[-1] - times_ns[0]) / (time.process_time() - began_s))
    print(f"{frames} frames, {differences} differences: {max(speeds):.1f} times real time")
    return 0


def decode_recordings(options: argparse.Namespace) -> int:
    """Print figures of the whole command, with the start and the end of its processes."""
    print("workers  seconds   frames  frames/s  processor ms/frame  peak MB of a process", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "skin32.mcap"
        record(path, load_plate("skin32"), 60.0 * options.minutes)
        for workers in options.workers:
            output = Path(temporary) / f"decoded-{workers}"
            asked = ("--output", str(output), "--workers", str(workers), "--chunk-seconds", "15", "--json")
            began_s, used_s, peak = time.monotonic(), children_s(), 0
            with child(*COMMAND, "decode-recordings", str(path), *asked, stdout=subprocess.PIPE) as process:
                while process.poll() is None:
                    peak = max([peak, *rss_bytes(process.pid)])
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(LOOK_S)
                took_s, used_s = time.monotonic() - began_s, children_s() - used_s
                assert process.stdout is not None  # noqa: S101 - it is a pipe
                frames = json.loads(process.stdout.read())["frames"]
            row = f"{workers:7} {took_s:8.1f} {frames:8} {frames / took_s:9.1f} {1e3 * used_s / frames:19.1f}"
            print(f"{row} {peak / 1e6:21.0f}", flush=True)
    return 0


def children_s() -> float:
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    figures = parser.add_subparsers(required=True, metavar="FIGURE")
    for name, run, seconds in (("demo", demo, 20.0), ("daemon", daemon, 20.0), ("replay", replay, 60.0)):
        figure = figures.add_parser(name)
        figure.set_defaults(run=run)
        figure.add_argument("--seconds", type=float, default=seconds, help="default: %(default)g")
        if name == "daemon":
            figure.add_argument("--baseline", type=Path, metavar="DIR", help="another checkout, measured in turns")
            figure.add_argument("--plate", action="append", help="default: quartz16 and skin32")
            figure.add_argument("--rate", type=float, metavar="HZ", help="frames a second, other than the plate's")
            figure.add_argument("--turns", type=int, default=5, help="of each checkout (default: %(default)s)")
        if name == "replay":
            figure.add_argument("--file", type=Path, help="a recording (default: quartz16, emulated)")
    figure = figures.add_parser("decode-recordings")
    figure.set_defaults(run=decode_recordings)
    figure.add_argument("--minutes", type=float, default=2.0, help="recorded; 0.9 GB each (default: %(default)g)")
    figure.add_argument("--workers", type=int, nargs="+", default=[1, 2], help="default: 1 2")
    options = parser.parse_args()
    return int(options.run(options))


if __name__ == "__main__":
    sys.exit(main())
