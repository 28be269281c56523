"""Tables of `stages.py`, and stages that cost more than in its record."""

import math
from typing import TypedDict

LIMIT = 1.10  # times the recorded instructions
BEGIN, END = "<!-- stages: make bench -->\n", "<!-- /stages -->\n"


class Cost(TypedDict):
    """Processor time of one frame."""

    name: str
    us: float
    spread_percent: float
    ours_over: float  # median ratio of ours to this, in one round


class StageRecord(TypedDict):
    """A stage compared with its peer and its limit; instructions are those of one frame."""

    ours: Cost
    peer: Cost
    limit: Cost
    instructions: float | None  # None: valgrind would need minutes for its set-up


class GrowthRecord(TypedDict):
    """Costs by size, with the exponent of their power law."""

    stage: str
    parameter: str
    sizes: list[int]
    costs: list[float]
    unit: str
    exponent: float
    std: float


class Record(TypedDict):
    """Results of one run."""

    versions: dict[str, str]
    stages: dict[str, StageRecord]
    growth: list[GrowthRecord]


def regressions(counts: dict[str, float], record: Record | None) -> list[str]:
    """Return a line for each stage whose instructions exceed their record by more than 10 %."""
    stages = {} if record is None else record["stages"]
    recorded = {name: stage["instructions"] or math.inf for name, stage in stages.items()}
    return [
        f"{name}: {now:.0f} instructions a frame, {100 * (now / recorded[name] - 1):.1f} % above the record"
        for name, now in counts.items()
        if name in recorded and now > LIMIT * recorded[name]
    ]


def block(record: Record) -> str:
    """Return the tables as Markdown."""
    versions = "; ".join(f"{name} {version}" for name, version in record["versions"].items())
    return "\n".join(
        [
            f"Versions: {versions}.",
            "",
            "| stage | µs a frame | spread | peer | µs | ours / peer | limit | µs | ours / limit | instructions |",
            "| --- | ---: | ---: | --- | ---: | ---: | --- | ---: | ---: | ---: |",
            *(_row(name, stage) for name, stage in record["stages"].items()),
            "",
            "| stage | by | range | exponent | smallest | largest |",
            "| --- | --- | ---: | ---: | ---: | ---: |",
            *map(_growth_row, record["growth"]),
            "",
        ]
    )


def _row(name: str, stage: StageRecord) -> str:
    ours, cells = stage["ours"], []
    for other in (stage["peer"], stage["limit"]):
        cells += [other["name"], f"{other['us']:,.4g}", f"{other['ours_over']:.3g}"]
    instructions = "-" if stage["instructions"] is None else f"{stage['instructions']:,.0f}"
    figures = (f"{ours['us']:,.4g}", f"± {ours['spread_percent']:.0f} %", *cells, instructions)
    return f"| {name} | {' | '.join(figures)} |"


def _growth_row(growth: GrowthRecord) -> str:
    sizes, costs, unit = growth["sizes"], growth["costs"], growth["unit"]
    exponent = f"{growth['exponent']:.2f} ± {growth['std']:.2f}"
    figures = (f"{sizes[0]} to {sizes[-1]}", exponent, f"{costs[0]:,.4g} {unit}", f"{costs[-1]:,.4g} {unit}")
    return f"| {growth['stage']} | {growth['parameter']} | {' | '.join(figures)} |"


def with_block(page: str, record: Record) -> str:
    """Return a page whose generated block shows the record."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return before + BEGIN + block(record) + END + after
