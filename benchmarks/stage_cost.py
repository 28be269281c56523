"""Processor time of each stage per frame, as microseconds and as a ratio to a fixed loop, against what was recorded.

Run it with `make bench-cost`, or `python benchmarks/stage_cost.py [--checkout DIR] [--only TEXT] [--record]`.
`--checkout` measures another checkout that has a `.venv` of its own. `--record` writes `benchmarks/stage_cost.json` and
the table of docs/explanation/performance.md. Exit code 1 when a stage costs more than 15 % above its record.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

from stage_cost_parts import PARTS, Cost, Stages

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "benchmarks" / "stage_cost.json"
PAGE = ROOT / "docs" / "explanation" / "performance.md"
PRESENT, BASELINE = "present", "baseline"
LIMIT = 1.15
BEGIN, END = "<!-- stages: make bench-cost -->\n", "<!-- /stages -->\n"


def table(record: dict[str, Stages]) -> str:
    """Return the recorded figures as a table of Markdown."""
    present, baseline = record[PRESENT], record.get(BASELINE, {})
    lines = [
        "| stage | µs a frame | x loop | baseline, µs | baseline, x loop | present / baseline |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, cost in present.items():
        before = baseline.get(name)
        figures = ("", "", "") if before is None else (*_figures(before), f"{cost['ratio'] / before['ratio']:.2f}")
        lines.append("| " + " | ".join((name, *_figures(cost), *figures)) + " |")
    return "\n".join(lines) + "\n"


def _figures(cost: Cost) -> tuple[str, str]:
    return f"{cost['us']:.1f}", f"{cost['ratio']:.2f}"


def write_page(record: dict[str, Stages]) -> None:
    before, _, rest = PAGE.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(before + BEGIN + table(record) + END + after)


def measure(checkout: Path, only: str) -> Stages:
    stages: Stages = {}
    for title, part in PARTS.items():
        if only in title:
            print(f"measuring: {title}", file=sys.stderr, flush=True)
            with tempfile.TemporaryDirectory() as folder:
                stages |= part(checkout / ".venv" / "bin" / "python", Path(folder))
    return stages


def report(stages: Stages, recorded: Stages) -> list[str]:
    """Print the stages and their records; return those that cost too much."""
    dear = []
    print(f"{'stage':44} {'us a frame':>11} {'x loop':>9} {'recorded':>9} {'ratio':>6}")
    for name, cost in stages.items():
        line = f"{name:44} {cost['us']:11.1f} {cost['ratio']:9.2f}"
        if name in recorded:
            ratio = cost["ratio"] / recorded[name]["ratio"]
            line += f" {recorded[name]['ratio']:9.2f} {ratio:6.2f}"
            if ratio > LIMIT:
                dear.append(name)
                line += "  more than 15 % above its record"
        print(line)
    return dear


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkout", type=Path, default=ROOT, help="checkout to measure (default: this one)")
    parser.add_argument("--only", default="", help="parts whose title contains this text")
    parser.add_argument("--record", action="store_true", help="keep the figures as the record of this checkout")
    options = parser.parse_args()
    record: dict[str, Stages] = json.loads(RECORD.read_text()) if RECORD.exists() else {PRESENT: {}}
    stages = measure(options.checkout.absolute(), options.only)
    kind = PRESENT if options.checkout == ROOT else BASELINE
    dear = report(stages, record.get(kind, {}))
    if options.record:
        record[kind] = record.get(kind, {}) | stages
        RECORD.write_text(json.dumps(record, indent=1) + "\n")
        write_page(record)
        return 0
    return 1 if dear else 0


if __name__ == "__main__":
    sys.exit(main())
