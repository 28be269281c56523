"""Calibration of a channelised force plate: f0 untouched, K under known masses, and what other sites feel of them."""

import tomllib
from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulated_loads import COMB_NOMINAL, COMB_TRUE, IDEAL, Loads, Touches, comb_frames, comb_text, fitted, lead

from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import Coupling
from resonator_daemon.tools.calibration.load_procedure import LoadProcedure, Prompt
from resonator_daemon.tools.calibration.plate_file import with_record
from resonator_daemon.tools.calibration.record import Record, make_record, notes
from resonator_daemon.tools.calibration.steps import CalibrationRefusedError, LoadRequest, plan_steps

REFERENCE_ERROR = 1.5e-6  # of the emulated board's clock, by which all of its frequencies are low
WANTED = LoadRequest(sites=(1, 7, 12), hold_s=1.5)
IDS = COMB_TRUE.site_ids.tolist()


def calibrated(wanted: LoadRequest, folder: Path, physics: str = IDEAL) -> tuple[LoadProcedure, Record, list[str]]:
    steps, touches = plan_steps(wanted, COMB_NOMINAL), Touches(physics=physics)
    touches.follow(steps)
    procedure, loads = LoadProcedure(COMB_NOMINAL, steps, 60.0), Loads(COMB_NOMINAL, COMB_TRUE)
    list(lead(procedure, COMB_NOMINAL, comb_frames(COMB_TRUE, touches, folder), loads))
    assert procedure.done
    outcome = fitted(procedure, wanted, loads)
    record = make_record(outcome, calibration_id="a1", unit="EMU-0001", today=date(2026, 11, 21), valid_days=30)
    return procedure, record, notes(outcome, record)


def sensitivity_errors(record: Record) -> Any:
    loaded = [tone for tone in record.tones if tone.sensitivity is not None]
    rows = [IDS.index(tone.site) for tone in loaded]
    return np.array([tone.sensitivity for tone in loaded]) / COMB_TRUE.tones.sensitivity[rows] - 1


def true_ratio(felt: Coupling) -> float:
    """Boussinesq's share below a point load, comb16's cover of 2.5 mm."""
    place = {site.id: np.array(site.position_mm) for site in COMB_TRUE.sites}
    squared = float(((place[felt.pressed] - place[felt.measured]) ** 2).sum())
    return 1 / (1 + squared / 6.25) ** 1.5


def test_all_sites_of_an_ideal_plate(tmp_path: Path) -> None:
    _, record, _ = calibrated(replace(WANTED, sites=(), hold_s=0.7), tmp_path)
    assert list(record.calibration.sites) == IDS
    assert np.abs(sensitivity_errors(record)).max() < 3e-4
    assert len(record.tones) == 16
    f0_hz = np.array([tone.f0_hz for tone in record.tones])
    assert np.abs(f0_hz * (1 + REFERENCE_ERROR) / COMB_TRUE.tones.f0_hz - 1).max() < 4e-9  # the file was 20e-6 off
    assert len(record.calibration.coupling) == 240  # even the farthest feels 0.2 %
    assert max(abs(felt.ratio - true_ratio(felt)) for felt in record.calibration.coupling) < 3e-4


def test_sites_that_were_not_loaded_get_their_f0_and_keep_their_sensitivity(tmp_path: Path) -> None:
    _, record, printed = calibrated(WANTED, tmp_path)
    plate = Plate.model_validate(tomllib.loads(with_record(comb_text(), record)))
    found, before = plate.tones, COMB_NOMINAL.tones
    assert np.abs(found.f0_hz * (1 + REFERENCE_ERROR) / COMB_TRUE.tones.f0_hz - 1).max() < 4e-9
    changed = (found.sensitivity != before.sensitivity).any(axis=1)
    assert {IDS[row] for row in np.flatnonzero(changed)} == {1, 7, 12}
    assert set(plate.calibration.sites) == {1, 7, 12}
    assert len(plate.calibration.residuals) == 3
    assert [(felt.pressed, felt.measured) for felt in plate.calibration.coupling] == [
        (felt.pressed, felt.measured) for felt in record.calibration.coupling
    ]
    assert {felt.pressed for felt in record.calibration.coupling} == {1, 7, 12}
    assert all(felt.pressed != felt.measured for felt in record.calibration.coupling)
    assert "not loaded, sensitivities kept: sites 3, 9" in " ".join(printed)


def test_hysteresis_and_creep_are_fitted_though_a_rest_of_them_stays_on_the_untouched_plate(tmp_path: Path) -> None:
    wanted = replace(WANTED, sites=(7, 1), response=True, response_hold_s=20.0)
    _, record, _ = calibrated(wanted, tmp_path, f"{IDEAL}hysteresis_fraction = 0.01\ncreep_fraction = 0.005\n")
    assert record.response.hysteresis_newton == pytest.approx(0.1, rel=0.01)
    assert record.response.creep_fraction == pytest.approx(0.005, rel=0.02)
    assert record.response.creep_time_s == pytest.approx(20.0, rel=0.02)
    assert np.abs(sensitivity_errors(record)).max() < 3e-4


def lead_on(touches: Touches, folder: Path, plate: Plate = COMB_NOMINAL, true: Plate = COMB_TRUE) -> list[Prompt]:
    procedure = LoadProcedure(plate, plan_steps(WANTED, plate), 4.0)
    return list(lead(procedure, plate, comb_frames(true, touches, folder), Loads(plate, true)))


def from_the_start(site_id: int, newton: float, seconds: float) -> str:
    line = f"[[touches]]\nsite = {site_id}\nforce_newton = {newton}\nhold_s = {seconds}\n"
    return f"{line}start_s = 0.0\nrise_s = 0.0\nfall_s = 0.2\n"


@pytest.mark.parametrize("start_s", [0.3, 1.5])
def test_a_plate_that_is_touched_while_its_baseline_is_taken_is_refused(tmp_path: Path, start_s: float) -> None:
    touches = Touches()
    touches.press(11, 0.5, start_s, 20.0)
    with pytest.raises(CalibrationRefusedError, match="baseline: site 11 is touched"):
        lead_on(touches, tmp_path)


def test_a_plate_that_was_calibrated_before_shows_that_it_is_pressed(tmp_path: Path) -> None:
    calibration = COMB_TRUE.calibration.model_copy(update={"id": "a1"})
    touches = Touches(seconds=12.0)
    known = COMB_TRUE.model_copy(update={"calibration": calibration})
    with pytest.raises(CalibrationRefusedError, match=r"step 1 .* nothing was placed"):
        lead_on(touches, tmp_path, known)
    touches.lines.append(from_the_start(11, 0.7, 20.0))
    with pytest.raises(CalibrationRefusedError, match=r"baseline: site 11 is touched \(0\.\d+ N by the plate file"):
        lead_on(touches, tmp_path, known)


def test_a_silent_tone_is_named(tmp_path: Path) -> None:
    def deaf() -> Iterator[tuple[Any, ...]]:
        for *frame, known in comb_frames(COMB_TRUE, Touches(seconds=10.0), tmp_path):
            known[2, 4] = False
            yield *frame, known

    procedure = LoadProcedure(COMB_NOMINAL, plan_steps(WANTED, COMB_NOMINAL), 3.0)
    with pytest.raises(CalibrationRefusedError, match=f"channel 2 receives no tone .without sites {IDS[4]}."):
        list(lead(procedure, COMB_NOMINAL, deaf(), Loads(COMB_NOMINAL, COMB_TRUE)))
