"""The table of stages: its exponents, its ratios, its page, and regressions."""

import json
from pathlib import Path

import pytest
from stage_measure import Work, fit_growth, in_turns
from stage_report import BEGIN, END, Cost, Record, StageRecord, block, regressions

ROOT = Path(__file__).parents[1]
COST: Cost = {"name": "other", "us": 2.0, "spread_percent": 3.0, "ours_over": 0.5}
STAGE: StageRecord = {"ours": COST, "peer": COST, "limit": COST, "instructions": 1000.0}
RECORD: Record = {"versions": {"numpy": "2"}, "stages": {"map": STAGE}, "growth": []}


def test_the_exponent_of_a_power_law_is_fitted_with_its_error() -> None:
    exact = fit_growth([16, 64, 256, 1024], [3.0 * size**1.5 for size in (16, 64, 256, 1024)])
    assert exact == pytest.approx((1.5, 0.0, 16, 1024), abs=1e-12)
    bent = fit_growth([1, 10, 100], [1.0, 100.0, 100.0])  # by hand: a slope of 1, residuals of 1/3, -2/3, 1/3 decades
    assert (bent.exponent, bent.std) == pytest.approx((1.0, 3**-0.5))


def test_works_are_measured_in_turns_by_a_clock_of_processor_time() -> None:
    now_s = [0.0]
    works = [Work(name, lambda s=s: now_s.__setitem__(0, now_s[0] + s), 4) for name, s in (("a", 2e-3), ("b", 8e-3))]
    ours, peer = in_turns(works, lambda: now_s[0])
    assert ours == pytest.approx((500.0, 0.0, 1.0), abs=1e-6)
    assert peer == pytest.approx((2000.0, 0.0, 0.25), abs=1e-6)


def test_a_stage_that_executes_more_than_10_percent_above_its_record_is_a_regression() -> None:
    assert regressions({"map": 1099.0, "new": 1e9}, RECORD) == regressions({"map": 1101.0}, None) == []
    assert [line.partition(":")[0] for line in regressions({"map": 1101.0}, RECORD)] == ["map"]


def test_the_page_shows_the_record_of_this_commit() -> None:
    assert "| map | 2 | ± 3 % | other | 2 | 0.5 | other | 2 | 0.5 | 1,000 |" in block(RECORD).splitlines()
    record, page = ROOT / "benchmarks" / "stages.json", ROOT / "docs" / "explanation" / "performance.md"
    shown = page.read_text().partition(BEGIN)[2].partition(END)[0]
    assert shown == (block(json.loads(record.read_text())) if record.exists() else "")
