"""A plan of codes as tables, object and picture."""

import io

import numpy as np
import pytest
from rich.console import Console

from resonator_daemon.forces.code_plan import ForceNoise, GuardBand
from resonator_daemon.forces.code_trials import Outcomes
from resonator_daemon.forces.codes import CodeOverlap
from resonator_daemon.plate import load_plate
from resonator_daemon.view.code_plan import CodePlan, Trials


def make_plan() -> CodePlan:
    plate = load_plate("quartz16")
    order = np.argsort(-plate.tones.f0_hz.mean(axis=1))
    codes = np.empty(16, np.int64)
    codes[order] = np.arange(1, 17)
    return CodePlan(
        plate=plate,
        codes=codes,
        step=360e-6,
        guard=GuardBand(81.9e-6, 2.4e-6, 2e-6, 9.1e-6, 0.0, 0.0, 0.0),
        too_near=((2, 15),),
        overlaps=(CodeOverlap(0, 5, 2, 80.0, 120.0),),
        refused=("too narrow",),
        trapped_band=0.015,
        baud=4e6,
        window_s=0.01,
        has_pilot=True,
        noise={"one_channel": ForceNoise(3e-4, 4e-4, 5e-4)},
        trials=Trials(50, 2, Outcomes(990, 0, 1, 9), Outcomes(40, 10, 0, 0), {1e-5: 0.001}),
    )


def rendered(plan: CodePlan) -> str:
    stream = io.StringIO()
    Console(file=stream, width=100, highlight=False).print(plan)
    return stream.getvalue()


def row(text: str, start: str) -> list[str]:
    return next(line[len(start) :].split() for line in text.splitlines() if line.startswith(start))


def test_tables_tell_the_ladder_from_the_highest_tone_down() -> None:
    text = rendered(make_plan())
    first = [line.split() for line in text.splitlines()[1:17]]
    assert [int(cells[0]) for cells in first] == list(range(1, 17))
    assert first[0][:6] == ["1", "14", "-7.30", "-8.20", "9996018.0", "-7.18"]
    tones_hz = [float(cells[4]) for cells in first]
    assert tones_hz == sorted(tones_hz, reverse=True)
    # f0 / (1 - K F) with K F = -71.8 ppm.
    assert float(first[0][6]) == pytest.approx(9996018.0 / 1.0000718, abs=0.2)
