"""The emulated plate whose force tones are all heard: forces, noise, phase and warmth, read back from its records."""

import numpy as np
import pytest
from scenarios import steady
from tone_fields import counted_fields

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate, load_plate
from simulators.comb_plate import CombPlate
from simulators.physics import Physics
from simulators.scenario import Scenario
from simulators.scenario_file import Touch

GATE_TICKS = 1_250_000
GATE_S = 5e-3
PLATE, QUARTZ = load_plate("comb16"), load_plate("quartz16")
INDEX = {int(site): index for index, site in enumerate(PLATE.site_ids)}


def emulated(*touches: Touch, plate: Plate = PLATE, seed: int = 4, **physics: float) -> CombPlate:
    chosen = Physics(ideal=True, **{"white_fm": 0.0, "reference_error": 0.0, **physics})
    return CombPlate(plate, Scenario(touches, None, plate, physics=chosen), seed)


def count(plate: CombPlate, frames: int, at_s: float = 1.0, gate_ticks: int = GATE_TICKS) -> dict[str, Floats]:
    return counted_fields(plate, frames, at_s, gate_ticks)


def frequency_hz(plate: CombPlate, fields: dict[str, Floats]) -> Floats:
    description = plate.description
    oscillator_hz = (
        description.oscillator_millihertz + description.oscillator_spacing_millihertz * np.arange(description.tones)
    ) * 1e-3
    return fields["offset_hz16"] / 2**16 + oscillator_hz


@pytest.mark.parametrize("reference_error", [-12e-6, 0.0, 1.5e-6])
def test_forces_of_two_touches_come_back_from_every_site_and_corner(reference_error: float) -> None:
    plate = emulated(
        steady(5.0, site=7), steady(0.4, site=16), reference_error=reference_error, sensitivity_scatter=0.0
    )
    fields = count(plate, 40)
    true_hz = frequency_hz(plate, fields).mean(axis=0).T * (1 + reference_error)
    force = (1 - PLATE.tones.f0_hz / true_hz) / PLATE.tones.sensitivity
    place = {site.id: np.array(site.position_mm) for site in PLATE.sites}
    for site, index in INDEX.items():
        spread = [
            newton / (1 + ((place[site] - place[at]) ** 2).sum() / 6.25) ** 1.5 for newton, at in ((5, 7), (0.4, 16))
        ]
        assert force[index] == pytest.approx(np.full(4, sum(spread)), abs=2e-3)
    assert set(fields["flags"].ravel()) == {0}


def test_noise_is_that_of_100_dbhz_at_the_best_corner_and_by_level_in_the_others() -> None:
    plate = emulated()
    fields = count(plate, 800)
    offset_hz = fields["offset_hz16"] / 2**16
    bound_hz = np.sqrt(6 / (4 * np.pi**2 * 1e10 * GATE_S**3))
    level_db = -fields["attenuation_db256"][0] / 256
    expected = bound_hz * 10 ** ((level_db.max(axis=0) - level_db) / 20)
    ratio = offset_hz.std(axis=0, ddof=1) / expected
    assert np.sqrt((ratio**2).mean()) == pytest.approx(1.0, abs=0.02)
    assert ratio.std() < 0.05
    assert 2 ** ((fields["sigma_code"][0] - 128) / 8) == pytest.approx(expected, rel=0.045)
    assert np.abs(np.corrcoef(offset_hz[:, :, 3].T) - np.eye(4)).max() < 0.15


def test_oscillator_noise_is_common_to_the_corners_of_a_site_and_has_the_slope_of_a_regression() -> None:
    plate = emulated(white_fm=1e-7)
    offset_hz = count(plate, 3000)["offset_hz16"] / 2**16
    y = (offset_hz - offset_hz.mean(axis=0)) / 1e7
    # A regression over a gate sees 1.2 times the white noise of the mean.
    assert (y**2).mean() / (1e-14 / GATE_S) == pytest.approx(1.2, rel=0.03)
    correlation = np.corrcoef(y[:, :, [2, 11]].reshape(3000, -1).T)  # channel 0's two tones, channel 1's, ...
    assert np.all(correlation[0::2, 0::2] > 0.98)
    assert np.abs(correlation[0::2, 1::2]).max() < 0.1


def test_a_warm_finger_shifts_its_site_and_a_temperature_tone_tells_how_warm_that_is() -> None:
    content = PLATE.model_dump(mode="json", exclude_none=True)
    for index, site in enumerate(content["sites"]):
        site["tones"].append({"signal": "temperature", "sensitivity": [9e-6] * 4})
        for number, tone in enumerate(site["tones"]):
            tone["f0_hz"] = [9.9e6 + 4000.0 * (2 * index + number)] * 4
    warm_plate = Plate.model_validate(content)
    plate = emulated(
        steady(1.0, site=7, kelvin=308.15), plate=warm_plate, temperature_coefficient=-1e-6, sensitivity_scatter=0.0
    )
    plate.count(0, 0, 2 * 10**7, 200)  # 16 s: three time constants
    fields = count(plate, 20, at_s=16.0)
    hz = frequency_hz(plate, fields).mean(axis=0)
    f0_hz, index = warm_plate.tones.f0_hz.T, INDEX[7]
    warmer = 10.0 * (1 - np.exp(-16.05 / 5))
    assert hz[:, 2 * index + 1] / f0_hz[:, 2 * index + 1] - 1 == pytest.approx(np.full(4, 9e-6 * warmer), rel=1e-3)
    force = (1 - f0_hz[:, 2 * index] / hz[:, 2 * index]) / warm_plate.tones.sensitivity[2 * index]
    expected = 1.0 - 1e-6 * warmer / warm_plate.tones.sensitivity[2 * index, 0]
    assert force == pytest.approx(np.full(4, expected), abs=2e-3)
    others = [tone for tone in range(1, 32, 2) if tone != 2 * index + 1]
    assert hz[:, others] == pytest.approx(f0_hz[:, others], abs=0.1)
