"""What each stage of a frame costs against its record: processor time, instructions, and the least work of its kind.

Run it with `make bench`, or `python benchmarks/stages.py [--record] [--count]`. A stage and its limit, work that any
such program contains, run in turns, so that other programs slow both; figures are medians. Instructions are counted by
valgrind in a second process; `--count` counts them only (`make bench-cost`). Exit code 1 when a stage executes more
than 10 % above its record. `--record` writes `stages.json` and the table of docs/explanation/performance.md.
"""

import argparse
import json
import math
import os
import pickle
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "benchmarks" / "stages.json"
PAGE = ROOT / "docs" / "explanation" / "performance.md"
PACKAGES = ("numpy", "scipy", "pydantic", "paho-mqtt", "mcap")
BEGIN, END = "<!-- stages: make bench -->\n", "<!-- /stages -->\n"
EXCEEDED = 1.10  # times the recorded instructions
BATCH_S = 0.01  # of processor time, at least, between two readings of the clock
ROUNDS_MIN, ROUNDS_MAX, STAGE_S = 5, 40, 4.0
COUNTED, SKIN = "counted", "skin.pickle"

Clock = Callable[[], float]
Record = dict[str, Any]


class Work(NamedTuple):
    """Something to measure: `run` processes `frames` frames."""

    name: str
    run: Callable[[], object]
    frames: int = 1


class Stage(NamedTuple):
    """A stage, and a limit: work that any such program contains."""

    name: str
    ours: Work
    limit: Work
    clock: Clock = time.process_time


def measure(stage: Stage, instructions: float | None) -> Record:
    """Measure a stage and its limit in turns; return µs of a frame, and the median ratio within one round."""
    works = (stage.ours, stage.limit)
    repeats, rounds = [_repeats(work, stage.clock) for work in works], list[list[float]]()
    until_s = time.monotonic() + STAGE_S
    while len(rounds) < ROUNDS_MIN or (time.monotonic() < until_s and len(rounds) < ROUNDS_MAX):
        rounds.append([_spent_us(work, count, stage.clock) for work, count in zip(works, repeats, strict=True)])
    spent = np.array(rounds)
    low, us, high = np.percentile(spent[:, 0], [25, 50, 75])
    figures = {"us": us, "spread_percent": 50 * (high - low) / us, "limit_us": np.median(spent[:, 1])}
    figures["over_limit"] = np.median(spent[:, 0] / spent[:, 1])
    rounded = {name: float(f"{value:.4g}") for name, value in figures.items()}
    return {**rounded, "limit": stage.limit.name, "instructions": instructions}


def _repeats(work: Work, clock: Clock) -> int:
    """Run a work once to warm it up; return how often it runs within a batch."""
    work.run()
    return max(1, round(BATCH_S / max(_spent_us(work, 1, clock) * work.frames * 1e-6, 1e-6)))


def _spent_us(work: Work, repeats: int, clock: Clock) -> float:
    started_s = clock()
    for _ in range(repeats):
        work.run()
    return (clock() - started_s) / (repeats * work.frames) * 1e6


def counts_of_all() -> dict[str, float]:
    """Return the instructions of one frame by stage; works of a skin come set up, for which valgrind needs minutes."""
    import stages_frames
    import stages_skin

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / SKIN).write_bytes(pickle.dumps(stages_skin.countable()))
        valgrind = ["valgrind", "--quiet", "--tool=callgrind", "--instr-atstart=no"]
        command = [*valgrind, f"--callgrind-out-file={folder / COUNTED}", sys.executable, __file__, "--counted", name]
        fixed = os.environ | {"PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1"}
        run = subprocess.run(command, env=fixed, stdout=subprocess.PIPE, text=True, check=True)
        counts: dict[str, float] = json.loads(run.stdout.splitlines()[-1])
        return counts | {"start of the daemon": stages_frames.start_instructions(folder)}


def print_counts(folder: Path) -> None:
    """Count each stage in this process, which callgrind runs; print JSON."""
    import stages_frames

    def control(option: str) -> None:
        command = ["callgrind_control", option, str(os.getpid())]
        subprocess.run(command, capture_output=True, check=True)

    def counted(run: Callable[[], object]) -> int:
        control("--zero")
        control("--instr=on")
        run()
        control("--instr=off")
        before = set(folder.glob(f"{COUNTED}.*"))
        control("--dump")
        (made,) = set(folder.glob(f"{COUNTED}.*")) - before
        found = re.search(r"^totals: (\d+)", made.read_text(), re.MULTILINE)
        assert found is not None  # noqa: S101 - callgrind writes it
        made.unlink()
        return int(found[1])

    empty, counts = counted(lambda: None), dict[str, float]()
    with ExitStack() as stack:
        works = ((stage.name, stage.ours) for stage in stages_frames.stages(stack, folder))  # set up at their turn
        for name, work in chain(works, pickle.loads((folder / SKIN).read_bytes()).items()):
            work.run()  # warms up
            counts[name] = round((counted(work.run) - empty) / work.frames)
            print(f"counted: {name}", file=sys.stderr, flush=True)
    print(json.dumps(counts))


def versions() -> dict[str, str]:
    """Return what the figures depend on."""
    describe = ["git", "describe", "--always", "--dirty"]
    commit = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True, check=False)
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
    blas = next(each for each in threadpool_info() if each["user_api"] == "blas")
    return {
        "commit": commit.stdout.strip(),
        "Python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
        "BLAS": f"{blas['internal_api']} {blas['version']} ({blas['architecture']})",
        "kernel": platform.release(),
        "processor": f"{model}, {os.cpu_count()} cores",
    }


def run(counts: dict[str, float], recorded: Record) -> Record:
    import stages_frames
    import stages_skin

    found: Record = {"versions": versions(), "stages": {}}
    with ExitStack() as stack, threadpool_limits(1):
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for stage in chain(stages_frames.stages(stack, folder), stages_skin.stages(), [stages_frames.start(folder)]):
            now = found["stages"][stage.name] = measure(stage, counts.get(stage.name))
            before = recorded["stages"].get(stage.name)
            times = f", {now['over_limit'] / before['over_limit']:.2f} x the record" if before else ""
            print(f"{stage.name}: {now['us']} µs{times}", file=sys.stderr, flush=True)
    return found


def regressions(counts: dict[str, float], recorded: Record) -> list[str]:
    """Return a line for each stage whose instructions exceed their record by more than 10 %."""
    before = {name: stage["instructions"] or math.inf for name, stage in recorded["stages"].items()}
    return [
        f"{name}: {now:.0f} instructions a frame, {100 * (now / before[name] - 1):.1f} % above the record"
        for name, now in counts.items()
        if name in before and now > EXCEEDED * before[name]
    ]


def block(record: Record) -> str:
    """Return the table as Markdown."""
    lines = [
        f"Versions: {'; '.join(f'{name} {version}' for name, version in record['versions'].items())}.",
        "",
        "| stage | µs a frame | spread | limit | µs | times the limit | instructions |",
        "| --- | ---: | ---: | --- | ---: | ---: | ---: |",
    ]
    for name, stage in record["stages"].items():
        instructions = "-" if stage["instructions"] is None else f"{stage['instructions']:,.0f}"
        ours = f"{stage['us']:,.4g} | ± {stage['spread_percent']:.0f} %"
        limit = f"{stage['limit']} | {stage['limit_us']:,.4g} | {stage['over_limit']:.3g}"
        lines.append(f"| {name} | {ours} | {limit} | {instructions} |")
    return "\n".join([*lines, ""])


def write_record(found: Record) -> None:
    RECORD.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n")
    before, _, rest = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(before + BEGIN + block(found) + END + rest.partition(END)[2])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="keep the figures as the record of this checkout")
    parser.add_argument("--count", action="store_true", help="count instructions only")
    parser.add_argument("--counted", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.counted:
        print_counts(options.counted)
        return 0
    recorded: Record = json.loads(RECORD.read_text())
    counts = counts_of_all()
    for name, instructions in counts.items() if options.count else ():
        print(f"{name:50} {instructions:14,.0f} instructions a frame")
    if not options.count:
        found = run(counts, recorded)
        print(block(found))
        if options.record:
            write_record(found)
    lines = regressions(counts, recorded)
    print("\n".join(lines) or "no stage executes more than 10 % above its record", file=sys.stderr)
    return 1 if lines and not options.record else 0


if __name__ == "__main__":
    sys.modules["stages"] = sys.modules["__main__"]  # whose classes the stages use
    sys.exit(main())
