"""What a plate file says, as the arguments of measurement: in the order of the sites, with what it leaves out."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from resonator_daemon.base import plate as plate_module
from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.board.config.tables import Measurement
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.measure.sensors.plate_sites import force_sites

PLATES = Path(plate_module.__file__).parent / "plates"
QUARTZ, COMB = load_plate("quartz16"), load_plate("comb16")


def test_a_daemon_of_captured_tones_loads_no_scipy() -> None:
    code = (
        "import sys, resonator_daemon.daemon.service.daemon; from resonator_daemon.base.plate import load_plate;"
        "from resonator_daemon.measure.sensors.base import sensor_of; sensor_of(load_plate('quartz16'));"
        "sys.exit('scipy' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_windows_and_steps_are_counted_in_gates() -> None:
    sensor = sensor_of(COMB, Measurement(window_ms=40, step_ms=15))
    processing = sensor.make_processing(COMB.tones.f0_hz.mean(axis=1))
    shape = (4, 16)
    zeros, sigma_code = np.zeros(shape, dtype=np.int32), np.full(shape, 76, dtype=np.uint8)
    given = [
        processing.push(number, 1_250_000 * number, zeros, zeros, sigma_code, np.ones(shape, dtype=bool))
        for number in range(12)
    ]
    assert [reading is not None for reading in given] == [False, False, True] * 4
    assert given[-1].window_s == pytest.approx(0.04)


def test_what_a_plate_file_does_not_say_is_what_is_usual() -> None:
    content = QUARTZ.model_dump(mode="json", exclude_none=True)
    for table in ("calibration", "response", "thermal"):
        content.pop(table, None)
    for site in content["sites"]:
        site["tones"][0].pop("temperature_coefficients", None)
    sites = force_sites(Plate.model_validate(content))
    assert sites.warmth.coefficients.tolist() == [[-5e-8, -0.5e-9, 1.08e-10]] * 16
    assert sites.warmth.coefficient_std == 5e-8  # from site to site, and not the 2e-8 of coefficients that are given
    assert (sites.model_error, sites.sensitivity_std) == (0.015, 0.0)
    assert sites.valid_newton == (-math.inf, math.inf)
    assert sites.response is None


def test_what_a_calibration_says_is_taken() -> None:
    content = QUARTZ.model_dump(mode="json", exclude_none=True)
    for number, site in enumerate(content["sites"]):
        site["tones"][0]["temperature_coefficients"] = [1e-8 * number, 2e-10, 3e-11]
    content["thermal"] = {
        "coefficient_std": 3e-9,
        "transient_s": -1e-7,
        "contact_std_kelvin": 4.0,
        "contact_time_s": 7.0,
    }
    content["response"] = {"hysteresis_newton": 0.1, "creep_fraction": 0.005, "creep_time_s": 20.0, "relative_std": 0.2}
    content["calibration"] = {
        "model_error": 0.02,
        "sensitivity_std": 0.001,
        "validity": {"force_newton": [0.1, 8.0], "kelvin": [290.0, 305.0]},
    }
    sites = force_sites(Plate.model_validate(content))
    assert sites.warmth.coefficients[:, 0] == pytest.approx(1e-8 * np.arange(16))
    assert sites.warmth.coefficients[3, 1:].tolist() == [2e-10, 3e-11]
    warmth = sites.warmth
    assert (warmth.coefficient_std, warmth.transient_s, warmth.contact_time_s) == (3e-9, -1e-7, 7.0)
    assert warmth.contact_std_kelvin.tolist() == [4.0] * 16
    assert (sites.model_error, sites.sensitivity_std, sites.valid_newton) == (0.02, 0.001, (0.1, 8.0))
    assert sites.valid_kelvin == pytest.approx((290.0 - 298.15, 305.0 - 298.15))
    response = sites.response
    assert response is not None
    assert (response.hysteresis_newton, response.creep_fraction, response.creep_time_s) == (0.1, 0.005, 20.0)
    stds = (response.hysteresis_std_newton, response.creep_fraction_std, response.creep_time_std_s)
    assert stds == pytest.approx((0.02, 0.001, 4.0))


def test_a_site_with_a_thermometer_needs_no_guess_of_what_touches_it() -> None:
    content = COMB.model_dump(mode="json", exclude_none=True)
    content["thermal"] = {"contact_std_kelvin": 3.0}
    warm = (2, 5)
    for index, site in enumerate(content["sites"]):
        f0_hz = [9.9e6 + 4000.0 * 2 * index] * 4
        site["tones"][0]["f0_hz"] = f0_hz
        if index in warm:
            thermometer = {"signal": "temperature", "sensitivity": [9e-6] * 4, "f0_hz": [f0_hz[0] + 4000.0] * 4}
            site["tones"].insert(0, thermometer)  # the tone of the force is not always the first
    plate = Plate.model_validate(content)
    sites = force_sites(plate)
    assert np.flatnonzero(sites.warmth.contact_std_kelvin == 0.0).tolist() == list(warm)
    assert np.all(sites.f0_hz[:, 0] == 9.9e6 + 8000.0 * np.arange(16))
    assert np.all(sites.sensitivity < 0)


@pytest.mark.parametrize("plate", ["quartz16", "comb16", "skin32"])
@pytest.mark.parametrize("kind", ["single-tone", "multitone", "skin", "nosuch"])
def test_a_kind_of_sensor_for_other_plates_is_refused(plate: str, kind: str, tmp_path: Path) -> None:
    text = (PLATES / f"{plate}.toml").read_text()
    (tmp_path / "p.toml").write_text(text.replace("[counter]\n", f'[counter]\nsensor = "{kind}"\n'))
    if kind == load_plate(plate).default_sensor:
        assert sensor_of(load_plate(tmp_path / "p.toml")).replaces == kind
    else:
        with pytest.raises(ConfigurationError, match=r"counter\.sensor"):
            sensor_of(load_plate(tmp_path / "p.toml"))
