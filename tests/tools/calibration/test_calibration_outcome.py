"""From an emulated plate to the record: K and f0 of the true plate, doubts, response and temperature."""

import tomllib
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from emulated_loads import IDEAL, NOMINAL, TRUE, Touches, fitted, frames, lead, true_text

from resonator_daemon.base.plate import Plate
from resonator_daemon.tools.calibration.load_procedure import LoadProcedure
from resonator_daemon.tools.calibration.outcome import Outcome
from resonator_daemon.tools.calibration.record import Record, make_record, notes
from resonator_daemon.tools.calibration.steps import LoadRequest, plan_steps

WANTED = LoadRequest(sites=(7, 12), masses_kg=(0.05, 0.2, 0.5), hold_s=1.5)
TODAY = date(2026, 11, 21)


def calibrated(wanted: LoadRequest, touches: Touches, folder: Path) -> tuple[LoadProcedure, Outcome]:
    steps = plan_steps(wanted, NOMINAL)
    touches.follow(steps)
    procedure = LoadProcedure(NOMINAL, steps, 60.0)
    list(lead(procedure, NOMINAL, frames(TRUE, touches, folder)))
    assert procedure.done
    return procedure, fitted(procedure, wanted)


def recorded(outcome: Outcome) -> Record:
    return make_record(outcome, calibration_id="a1", unit="EMU-0001", today=TODAY, valid_days=30)


def sensitivity_errors(record: Record) -> np.ndarray:
    index = [NOMINAL.site_ids.tolist().index(tone.site) for tone in record.tones]
    return np.array([tone.sensitivity for tone in record.tones]) / TRUE.tones.sensitivity[index] - 1


def test_ideal_sites_get_the_true_codes(tmp_path: Path) -> None:
    _, outcome = calibrated(WANTED, Touches(), tmp_path)
    record, calibration = recorded(outcome), recorded(outcome).calibration
    assert calibration.sites == (7, 12)
    assert np.abs(sensitivity_errors(record)).max() < 3e-4  # noise; 0.3 % is asked for
    for tone, row in zip(record.tones, (6, 11), strict=True):
        assert np.abs(np.array(tone.f0_hz) / TRUE.tones.f0_hz[row] - 1).max() < 5e-9  # the file was 20e-6 off
    assert max(calibration.residuals) < 0.01  # by far the most of it is creep that holds of 1.5 s do not rule out
    assert outcome.doubtful == ()
    assert outcome.swapped is None
    dates = calibration.date, calibration.expiry
    assert (calibration.id, calibration.unit, *dates) == ("a1", "EMU-0001", TODAY, date(2026, 12, 21))
    assert calibration.temperature_kelvin == 298.15
    assert calibration.validity.kelvin == pytest.approx((293.15, 303.15))
    assert calibration.validity.force_newton == pytest.approx((0.0, 0.5 * 9.80665))
    assert record.response is None
    printed = " ".join(notes(outcome, record))
    assert "values kept: sites 1, 2, 3, 4, 5, 6, 8, 9, 10, 11, 13, 14, 15, 16" in printed


def test_without_a_response_the_residual_states_hysteresis_and_creep(tmp_path: Path) -> None:
    wanted = replace(WANTED, sites=(7,), response=True, response_hold_s=40.0)
    physics = f"{IDEAL}hysteresis_fraction = 0.01\ncreep_fraction = 0.005\n"
    procedure, _ = calibrated(wanted, Touches(physics=physics), tmp_path)
    without = fitted(procedure, replace(wanted, response=False))
    assert len(without.doubtful) == 2  # lag passes for two bad loads; what they lie off is in the residual all the same
    record = recorded(without)
    (tone,), (residual_newton,) = record.tones, record.calibration.residuals
    errors = []
    for loading in procedure.loadings.values():
        f_hz = NOMINAL.tones.f0_hz[6] / (1 - loading.shift) / (1 + procedure.untouched.at(loading.times_s[0]))
        newton = np.mean((1 - np.array(tone.f0_hz) / f_hz) / tone.sensitivity)
        errors.append(newton - loading.step.force_newton)
    stated = np.hypot(np.sqrt(np.mean(np.square(errors))), without.creep_share * 0.5 * 9.80665)
    assert residual_newton == pytest.approx(stated, rel=2e-3)  # what it says it is
    assert residual_newton > 0.05


def test_a_sweep_gives_temperature_coefficients_against_the_pilot(tmp_path: Path) -> None:
    wanted = LoadRequest(sites=(7,), hold_s=0.5, kelvin=296.15, temperatures_kelvin=(288.15, 308.15))
    given = "temperature_coefficients = [-1.0e-6, 2.0e-9, 1.08e-10]\n"
    tone = "\n[[sites.tones]]\nsignal"
    before, site_7, after = true_text().partition("id = 7\n")
    warm = Plate.model_validate(tomllib.loads(before + site_7 + after.replace(tone, f"{tone[:-6]}{given}signal", 1)))
    steps = plan_steps(wanted, NOMINAL)
    touches = Touches()
    touches.follow(steps[:3])
    line = [(0.0, 296.15), (touches.seconds, 296.15)]
    for step in steps[3:]:
        line.append((touches.seconds + 0.1, step.kelvin))
        touches.seconds += 60.0  # the plate is at its new temperature long before the mass is laid on it
        touches.follow((step,))
        line.append((touches.seconds, step.kelvin))
    kelvin = ", ".join(f"[{time_s:.3f}, {value}]" for time_s, value in line)
    touches.physics = f"environment_kelvin = [{kelvin}]\n{IDEAL}"
    procedure = LoadProcedure(NOMINAL, steps, 90.0)
    news = list(lead(procedure, NOMINAL, frames(warm, touches, tmp_path)))
    assert "bring the plate to 288.15 K, then place 500 g on site 7" in [item.text for item in news]
    outcome = fitted(procedure, wanted)
    record = recorded(outcome)
    a, b, _ = record.tones[0].temperature_coefficients or (0, 0, 0)
    assert a == pytest.approx(-1.0e-6, abs=0.03e-6)
    assert b == pytest.approx(2.0e-9, abs=3e-9)
    # f0 holds at the reference, 2 K above the temperature of the loads; unmoved it would be 2e-6 off.
    assert np.abs(np.array(record.tones[0].f0_hz) / warm.tones.f0_hz[6] - 1).max() < 2e-7
    assert record.calibration.validity.kelvin == pytest.approx((283.15, 313.15))
