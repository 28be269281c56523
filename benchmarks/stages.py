"""Stages, their peers and their limits, in one run: processor time of a frame, instructions, growth exponents.

Run it with `make bench`, or `python benchmarks/stages.py [--record] [--count]`. Works of a stage run in turns, so that
other programs slow each of them; figures are medians. Instructions are counted by valgrind in a second process.
`--count` counts them only (`make bench-cost`). Exit code 1 when a stage executes more than 10 % above its record.
`--record` writes `benchmarks/stages.json` and the table of docs/explanation/performance.md, which a review shows.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path

import stages_force
import stages_live
import stages_skin
import stages_system
from stage_counts import counts_of_all
from stage_measure import Figures, Growth, Stage, Work, fit_growth, grow, in_turns
from stage_report import Cost, GrowthRecord, Record, StageRecord, block, regressions, with_block
from threadpoolctl import threadpool_info, threadpool_limits

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "benchmarks" / "stages.json"
PAGE = ROOT / "docs" / "explanation" / "performance.md"
PACKAGES = ("numpy", "scipy", "pydantic", "paho-mqtt", "mcap", "cobs", "tamaas")


def versions() -> dict[str, str]:
    """Return what the figures depend on."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True, check=False
    )
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


def cost(work: Work, figures: Figures) -> Cost:
    us, spread_percent, ours_over = (float(f"{value:.4g}") for value in figures)
    return Cost(name=work.name, us=us, spread_percent=spread_percent, ours_over=ours_over)


def measure(stage: Stage, instructions: float | None) -> StageRecord:
    works = [stage.ours, stage.peer, stage.limit]
    ours, peer, limit = map(cost, works, in_turns(works, stage.clock))
    return StageRecord(ours=ours, peer=peer, limit=limit, instructions=instructions)


def growth_record(growth: Growth) -> GrowthRecord:
    return power_law(growth.stage, growth.parameter, dict(zip(growth.sizes, grow(growth)[0], strict=True)), "µs")


def power_law(stage: str, parameter: str, costs: dict[int, float], unit: str) -> GrowthRecord:
    fit = fit_growth(list(costs), list(costs.values()))
    return GrowthRecord(
        stage=stage,
        parameter=parameter,
        sizes=list(costs),
        costs=[float(f"{each:.4g}") for each in costs.values()],
        unit=unit,
        exponent=round(fit.exponent, 3),
        std=round(fit.std, 3),
    )


def live_growth() -> Iterator[GrowthRecord]:
    """Measure daemons at real time; costs are those of a second, in percent of a core."""
    rates = {rate_hz: live.daemon_us * rate_hz * 1e-4 for rate_hz, live in stages_live.by_rate().items()}
    yield power_law("daemon of quartz16", "frame rate", rates, "% of a core")
    second = {count: count * stages_live.SHARED_HZ * 1e-4 for count in stages_live.PLATE_COUNTS}
    many = stages_live.by_plates()
    daemons = {count: many[count].daemon_us * factor for count, factor in second.items()}
    emulators = {count: many[count].emulator_us * factor for count, factor in second.items()}
    yield power_law("daemons of quartz16 at 200 frames/s", "plates", daemons, "% of a core")
    yield power_law("their emulators", "plates", emulators, "% of a core")


def run(counts: dict[str, float]) -> Record:
    started_s, found = time.monotonic(), Record(versions=versions(), stages={}, growth=[])

    def report(title: str) -> None:
        print(f"{time.monotonic() - started_s:5.0f} s  {title}", file=sys.stderr, flush=True)

    with ExitStack() as stack, threadpool_limits(1):
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        starts = [stages_system.start(stages_system.Starts(folder))]
        for stages in (stages_force.stages(), stages_skin.stages(), stages_system.stages(stack, folder), starts):
            for stage in stages:
                found["stages"][stage.name] = measure(stage, counts.get(stage.name))
                report(stage.name)
        for growths in (stages_force.growths(), stages_skin.growths(), stages_system.growths(stack, folder)):
            for growth in growths:
                found["growth"].append(growth_record(growth))
                report(f"{growth.stage} by {growth.parameter}")
    for record in live_growth():
        found["growth"].append(record)
        report(f"{record['stage']} by {record['parameter']}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", action="store_true", help="keep the figures as the record of this checkout")
    parser.add_argument("--count", action="store_true", help="count instructions only")
    options = parser.parse_args()
    recorded: Record | None = json.loads(RECORD.read_text()) if RECORD.exists() else None
    counts = counts_of_all(stages_skin.countable())
    if options.count:
        for name, instructions in counts.items():
            print(f"{name:50} {instructions:14,.0f} instructions a frame")
    else:
        found = run(counts)
        print(block(found))
        if options.record:
            RECORD.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n")
            PAGE.write_text(with_block(PAGE.read_text(), found))
    lines = regressions(counts, recorded)
    print("\n".join(lines) or "no stage executes more than 10 % above its record", file=sys.stderr)
    return 1 if lines and not options.record else 0


if __name__ == "__main__":
    sys.exit(main())
