"""A plan of codes as tables, object and picture."""

import io
import json
from dataclasses import replace

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


def test_tables_tell_what_it_costs_and_bears() -> None:
    text = rendered(make_plan())
    assert row(text, "together") == ["95.4"]
    assert row(text, "least between two tones") == ["360.0"]
    assert "pulling" not in text  # a cause without a share
    assert row(text, "link, single-tone") == [
        *("204", "bytes", "x", "1000/s"),
        *("204", "kB/s"),
        *("51%", "of", "4000000", "baud"),
    ]
    assert row(text, "one channel") == ["0.3", "0.4", "0.5"]
    assert row(text, "one site") == ["1000", "99.00%", "0", "(<", "0.3%)", "0.10%", "0.90%"]
    assert "Codes overlap on 2 of 50 plates drawn." in text
    assert "wrong: 0.10% at 10 ppm." in text
    assert "codes of sites 2 and 15 are too near" in text


def test_the_object_is_strict_json() -> None:
    found = json.loads(json.dumps(make_plan().as_json(), allow_nan=False))
    assert (found["ok"], found["refused"]) == (False, ["too narrow"])
    assert found["overlaps"] == [{"sites": [1, 6], "channel": 2, "spacing_ppm": 80.0, "needed_ppm": 120.0}]
    assert found["guard_band_ppm"]["step"] == pytest.approx(95.4)
    band = found["band"]
    # From the pilot at 10.01 MHz down to site 3 at 9935955.6 Hz, lowered by 49.1 ppm.
    assert band["used_hz"] == pytest.approx(10_010_000 - 9_935_955.6 * (1 - 49.1e-6), abs=0.1)
    assert band["share"] == pytest.approx(band["used_hz"] / 10.01e6 / 0.015)
    assert found["link"]["single-tone"]["share_of_baud"] == pytest.approx(0.51)
    assert found["trials"]["two_touches"] == {"right": 40, "partly": 10, "wrong": 0, "undecided": 0}
    alone = replace(make_plan(), step=float("nan"), has_pilot=False).as_json()
    assert alone["step_ppm"] is None
    assert alone["band"]["used_hz"] == pytest.approx(9_996_217.8 - 9_935_955.6 * (1 - 49.1e-6), abs=0.1)
