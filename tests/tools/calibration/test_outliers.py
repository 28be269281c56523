"""Loads that do not fit together and sensitivities that are not known: without a plate, from made-up readings."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from emulated_loads import NOMINAL, fitted

from resonator_daemon.tools.calibration.load_procedure import Loading, LoadProcedure
from resonator_daemon.tools.calibration.outcome import Outcome, OutlierSite, find_outliers, refuse_unknown_sensitivity
from resonator_daemon.tools.calibration.steps import STANDARD_GRAVITY, CalibrationRefusedError, LoadRequest, plan_steps

ONE = LoadRequest(sites=(1,))
NOISE = 1e-9
READINGS = 5
BAD = {3: 0.3}  # kilograms, by step


def outcome_of(
    wanted: LoadRequest,
    scatter: float = 0.0,
    laid_kg: dict[int, float] | None = None,
    seed: int = 1,
    creep_per_s: float = 0.0,
) -> tuple[Outcome, tuple[OutlierSite, ...]]:
    """Fit what a plate with its own file's codes reads; scatter is of each load and channel alone."""
    random = np.random.default_rng(seed)
    steps = plan_steps(wanted, NOMINAL)
    procedure = LoadProcedure(NOMINAL, steps, 60.0)
    procedure.untouched.times_s.append(0.0)
    procedure.untouched.common_mode.append(np.zeros(4))
    for step in steps:
        site = NOMINAL.site_ids.tolist().index(step.site_id)
        newton = (laid_kg or {}).get(step.number, step.mass_kg) * STANDARD_GRAVITY
        felt = newton * (1 + scatter * random.normal(size=4))
        times_s = 10.0 * step.number + 0.1 * np.arange(READINGS)
        growing = 1 + creep_per_s * (times_s - times_s[0])[:, None]
        shift = NOMINAL.tones.sensitivity[site] * felt * growing + NOISE * random.normal(size=(READINGS, 4))
        std = np.full((READINGS, 4), NOISE)
        procedure.loadings[step.number] = Loading(step, site, times_s[0] - 0.1, times_s, shift, std, 1e-10, None)
        procedure.released_s.append(times_s[-1] + 1.0)
    outcome = fitted(procedure, wanted)
    return outcome, find_outliers(outcome)


def test_three_loads_of_one_site_that_do_not_fit_are_found() -> None:
    outcome, (outlier,) = outcome_of(ONE, laid_kg=BAD)
    assert len(outcome.fit.residual_newton) == 2 * 3  # a row for each load that comes, and for each that goes
    assert outcome.doubtful == ()  # two of them always fit
    assert [step.number for step in outlier.steps] == [1, 2, 3]
    # Five times a scatter of 1.5 % in each of four channels, and masses good to 0.1 %. Two of three go into the line.
    load_newton = STANDARD_GRAVITY * math.sqrt((0.05**2 + 0.2**2 + 0.5**2) / 3)
    assert outlier.limit_newton == pytest.approx(5 * load_newton * math.hypot(0.0075, 0.001) / math.sqrt(3), rel=0.01)
    reported, felt = STANDARD_GRAVITY * np.array([0.05, 0.2, 0.5]), STANDARD_GRAVITY * np.array([0.05, 0.2, 0.3])
    slope, rest = np.polyfit(reported, felt, 1, w=1 / reported)  # scatter goes with the load
    assert outlier.residual_newton == pytest.approx(
        np.sqrt(np.mean((felt / slope - rest / slope - reported) ** 2)), rel=0.01
    )


@pytest.mark.parametrize("laid_kg", [{3: 0.45}, {3: 0.55}, {2: 0.17}, {2: 0.23}, {1: 0.03}, {1: 0.07}])
def test_a_load_that_puts_the_sensitivity_off_by_more_than_six_percent_does_not_pass(laid_kg: dict[int, float]) -> None:
    outcome, outliers = outcome_of(ONE, laid_kg=laid_kg)
    assert np.abs(outcome.fit.sensitivity / NOMINAL.tones.sensitivity[0] - 1).max() > 0.06
    assert outliers


def test_usual_scatter_is_no_outlier() -> None:
    outcomes = [outcome_of(ONE, scatter=0.015, seed=seed) for seed in range(300)]
    assert not any(outliers for _, outliers in outcomes)
    assert max(outcome.sensitivity_std[0] for outcome, _ in outcomes) < 0.05


def test_the_scatter_that_other_sites_show_is_allowed_for() -> None:
    wild = 0.06  # four times what the plate file says
    alone = sum(bool(outcome_of(ONE, wild, seed=seed)[1]) for seed in range(100))
    assert alone > 5
    several = replace(ONE, sites=tuple(range(1, 11)), masses_kg=(0.05, 0.2, 0.5))
    assert sum(len(outcome_of(several, wild, seed=seed)[1]) for seed in range(10)) == 0


def test_repeats_of_one_mass_can_contradict_each_other() -> None:
    (outlier,) = outcome_of(replace(ONE, masses_kg=(0.5,), repeats=2), laid_kg={2: 0.3})[1]
    assert outlier.site_id == 1


@pytest.mark.parametrize(
    ("wanted", "more"),
    [
        (ONE, {"laid_kg": BAD}),
        (replace(ONE, masses_kg=(0.5, 0.52)), {}),
        (ONE, {"creep_per_s": 0.004}),  # 8 % in 20 s
        (replace(ONE, mass_std=0.049, masses_kg=(0.05, 0.2)), {}),
    ],
)
def test_a_sensitivity_known_to_more_than_five_percent_is_refused(wanted: LoadRequest, more: dict[str, Any]) -> None:
    refuse_unknown_sensitivity(outcome_of(ONE, 0.015)[0])
    bad, _ = outcome_of(wanted, **more)
    assert bad.sensitivity_std[0] > 0.05
    with pytest.raises(CalibrationRefusedError, match="site 1:"):
        refuse_unknown_sensitivity(bad)
