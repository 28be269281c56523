"""The procedure on an emulated plate: it tells by itself what lies where, and waits where that is wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from emulated_loads import NOMINAL, TRUE, Touches, frames, lead

from resonator_daemon.tools.calibration.load_procedure import LoadProcedure, Prompt
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError, LoadRequest, plan_steps

WANTED = LoadRequest(sites=(7,), masses_kg=(0.1, 0.3), hold_s=1.0)


def kinds(news: list[Prompt]) -> list[tuple[str, int]]:
    return [(item.event, item.step.number if item.step else 0) for item in news]


def refused(procedure: LoadProcedure, touches: Touches, folder: Path) -> tuple[list[Prompt], str]:
    heard: list[Prompt] = []
    with pytest.raises(CalibrationRefusedError) as refusal:
        heard.extend(lead(procedure, NOMINAL, frames(TRUE, touches, folder)))
    return heard, str(refusal.value)


def test_right_loads_are_captured_one_after_the_other(tmp_path: Path) -> None:
    steps, touches = plan_steps(WANTED, NOMINAL), Touches()
    touches.follow(steps)
    procedure = LoadProcedure(NOMINAL, steps, 20.0)
    news = list(lead(procedure, NOMINAL, frames(TRUE, touches, tmp_path)))
    assert procedure.done
    assert kinds(news) == [
        ("untouched", 0), ("place", 1), ("captured", 1), ("remove", 1), ("place", 2), ("captured", 2), ("remove", 2)
    ]  # fmt: skip
    assert news[1].text == "place 100 g on site 7"
    for step in steps:
        loading = procedure.loadings[step.number]
        assert loading.times_s.shape == (10,)  # a second of tenths
        # The true plate by eq. (1); the pilot tells the reference error, 1.5e-6, that is still in f.
        f_hz = TRUE.tones.f0_hz[6] / (1 - TRUE.tones.sensitivity[6] * step.force_newton) / (1 + 1.5e-6)
        truth = 1 - NOMINAL.tones.f0_hz[6] / f_hz
        assert np.abs(loading.shift.mean(axis=0) - truth).max() < 5e-9  # 1 mN
        assert np.abs(procedure.untouched.at(loading.times_s[0]) + 1.5e-6).max() < 5e-9
        assert 0.0 < loading.times_s[0] - loading.since_s < 1.0
    assert len(procedure.released_s) == 2


def test_a_wrong_site_is_named_and_waited_out(tmp_path: Path) -> None:
    steps, touches = plan_steps(replace(WANTED, masses_kg=(0.1,)), NOMINAL), Touches()
    touches.load(13, 0.1, 2.0)
    touches.load(7, 0.1, 1.0)
    procedure = LoadProcedure(NOMINAL, steps, 20.0)
    news = list(lead(procedure, NOMINAL, frames(TRUE, touches, tmp_path)))
    assert kinds(news)[2:] == [("wrong_site", 1), ("captured", 1), ("remove", 1)]
    assert news[2].text == "site 13 carries a load, not site 7; place 100 g on site 7"
    assert procedure.done


def test_a_load_that_moves_is_not_captured_until_it_stands(tmp_path: Path) -> None:
    steps, touches = plan_steps(replace(WANTED, masses_kg=(0.1,), hold_s=2.0), NOMINAL), Touches()
    touches.press(7, 1.0, 3.0, 6.0)
    touches.press(7, 0.3, 4.0, 0.2)  # a finger that helps, in the middle of the hold
    procedure = LoadProcedure(NOMINAL, steps, 20.0)
    news = list(lead(procedure, NOMINAL, frames(TRUE, touches, tmp_path)))
    assert kinds(news)[2:] == [("unsteady", 1), ("captured", 1), ("remove", 1)]
    captured = procedure.loadings[1]
    assert captured.times_s[0] > 4.6
    assert np.ptp(captured.shift, axis=0).max() < 2e-8


def test_a_touched_plate_has_no_baseline(tmp_path: Path) -> None:
    touches = Touches()
    touches.press(11, 0.5, 0.2, 20.0)
    procedure = LoadProcedure(NOMINAL, plan_steps(WANTED, NOMINAL), 20.0)
    news, printed = refused(procedure, touches, tmp_path)
    assert news == []
    assert printed == "baseline: site 11 is touched; take everything off the plate and begin again"


def test_a_step_that_is_never_done_ends_the_calibration_with_the_reason(tmp_path: Path) -> None:
    steps = plan_steps(WANTED, NOMINAL)
    _, printed = refused(LoadProcedure(NOMINAL, steps, 4.0), Touches(seconds=12.0), tmp_path)
    assert printed == "step 1 (100 g on site 7): not done within 4 s (--timeout-s): nothing was placed"
    wrong = Touches()
    wrong.press(5, 1.0, 4.0, 20.0)
    _, printed = refused(LoadProcedure(NOMINAL, steps, 4.0), wrong, tmp_path)
    assert "site 5 carries a load, not site 7" in printed
    kept = Touches()
    kept.press(7, 0.1 * 9.80665, 4.0, 20.0)
    news, printed = refused(LoadProcedure(NOMINAL, steps, 4.0), kept, tmp_path)
    assert kinds(news)[-1] == ("remove", 1)
    assert "the last load was not taken away" in printed
