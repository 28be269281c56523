"""The emulated plates whose tones are all read: signal, noise, phase, gain and warmth, from their records."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scenarios import steady

from firmware_protocol.layouts import TONE_FIELDS
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate, load_plate
from simulators.comb_plate import CombPlate
from simulators.contact import pressed_signals
from simulators.physics import Physics
from simulators.plate import EmulatedPlate, record_type
from simulators.presses import Presses
from simulators.scenario import Scenario
from simulators.scenario_file import Touch
from simulators.skin_plate import SkinPlate
from simulators.world import World, with_world

RECORD = record_type(TONE_FIELDS)


def count(plate: EmulatedPlate, frames: int, at_s: float = 1.0) -> dict[str, Floats]:
    """Count frames from a time of the scenario; return each field (frames, channels, tones)."""
    gate_ticks = 1_250_000 if isinstance(plate, CombPlate) else 2_500_000
    counted = plate.count(0, round(at_s * 250e6), gate_ticks, frames)
    rows = np.array([[np.frombuffer(channel, RECORD) for channel in frame.channels] for frame in counted])
    return {name: rows[name].astype(np.float64) for name in RECORD.names or ()}


GATE_S = 5e-3
COMB = load_plate("comb16")
INDEX = {int(site): index for index, site in enumerate(COMB.site_ids)}


def emulated(*touches: Touch, plate: Plate = COMB, seed: int = 4, **physics: float) -> CombPlate:
    chosen = Physics(ideal=True, **{"white_fm": 0.0, "reference_error": 0.0, **physics})
    return CombPlate(plate, Scenario(touches, None, plate, physics=chosen), seed)


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
    force = (1 - COMB.tones.f0_hz / true_hz) / COMB.tones.sensitivity
    place = {site.id: np.array(site.position_mm) for site in COMB.sites}
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
    content = COMB.model_dump(mode="json", exclude_none=True)
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


SKIN = load_plate("skin32")
TO_TRIPLE = np.array([3 / (2 * 2e5), 1.0, 1.0])


def sigma_hz(fields: dict[str, Floats]) -> Floats:
    return 2 ** ((fields["sigma_code"][0] - 128) / 8)


@pytest.fixture(scope="module")
def still() -> dict[str, Floats]:
    return count(SkinPlate(World(SKIN), Scenario((), None, SKIN), seed=4), 150)


def test_signal_to_noise_ratio_is_30_db_in_the_triple_at_1_newton(still: dict[str, Floats]) -> None:
    offset_hz = still["offset_hz16"] / 2**16
    weight = sigma_hz(still) ** -2
    combined_hz = (offset_hz * weight).sum(axis=1) / weight.sum(axis=0)
    relative = combined_hz / SKIN.tones.f0_hz[:, 0] / SKIN.tones.sensitivity[:, 0]
    triple_std = relative.std(axis=0, ddof=1) * TO_TRIPLE[SKIN.tones.signal_index]
    signal = pressed_signals(SKIN.site_positions_m, 1e-3, 2e5, 0.5, (0.0, 0.0), 2.5e-3, 0.5, (0.0, 0.0, 1.0))
    signal *= TO_TRIPLE[:, np.newaxis]
    for row in range(3):  # equally noisy rows
        noise = np.sqrt((triple_std[SKIN.tones.signal_index == row] ** 2).mean())
        assert 20 * np.log10(np.sqrt((signal**2).mean()) / noise) == pytest.approx(30.0, abs=0.2)


def test_noise_of_each_corner_is_what_its_code_says(still: dict[str, Floats]) -> None:
    stated = sigma_hz(still)
    found = (still["offset_hz16"] / 2**16).std(axis=0, ddof=1)
    assert np.sqrt(((found / stated) ** 2).mean()) == pytest.approx(1.0, abs=0.01)
    # The code's steps of 1/8 octave, and the scatter of a standard deviation that comes from 150 frames.
    assert (found / stated).std() == pytest.approx(
        np.hypot((2 ** (1 / 16) - 1) / np.sqrt(3), 1 / np.sqrt(298)), rel=0.1
    )


def test_a_world_has_dead_signals_sites_elsewhere_and_a_common_walk() -> None:
    def offsets_hz(spec: str) -> Floats:
        scenario = Scenario((steady(1.0, position_mm=(0.0, 0.0)),), None, SKIN)
        return count(SkinPlate(with_world(SKIN, spec), scenario, seed=4), 40)["offset_hz16"][:, 0] / 2**16

    usual = offsets_hz("")
    dead, moved = (np.abs(offsets_hz(spec) - usual).mean(axis=0) for spec in ("dead=p_n@417", "positions_mm=0.1"))
    (tone,) = np.flatnonzero((SKIN.tones.signal_index == 0) & (SKIN.tones.site_index == 416))
    assert list(np.flatnonzero(dead)) == [tone]
    assert np.count_nonzero(moved) > 3000
    walk = (offsets_hz("common_walk=1e-6") - usual) / SKIN.tones.f0_hz[:, 0]
    assert np.diff(walk.mean(axis=1)).std() == pytest.approx(1e-6 * np.sqrt(0.01), rel=0.3)
    assert walk.std(axis=1).max() < 1e-9


def test_a_world_has_another_pressure_and_a_rigid_plate_below_the_skin() -> None:
    site = int(SKIN.site_ids[520])
    (tone,) = np.flatnonzero((SKIN.tones.signal_index == 0) & (SKIN.tones.site_index == 520))

    def pressed(spec: str) -> tuple[float, tuple[float | None, float | None]]:
        """Return the shift of p_n below a contact of 1 N, which is sheared by .1 N, and its radii."""
        presses = Presses(SKIN, "EMU-0001")
        plate = SkinPlate(with_world(SKIN, spec), Scenario((), None, SKIN, presses=presses), seed=4)
        still_hz = count(plate, 40)["offset_hz16"][:, 0, tone].mean()
        press = {"press": "a", "position_m": SKIN.site_positions_m[520].tolist(), "force_newton": [0.1, 0.0, 1.0]}
        assert presses.request(1, json.dumps(press).encode())["ok"]
        (contact,) = plate.count(0, 10**9, 2_500_000, 1)[0].contacts
        assert contact.site == site
        pressed_hz = count(plate, 40)["offset_hz16"][:, 0, tone].mean()
        return float(pressed_hz - still_hz), (contact.radius_m, contact.stick_radius_m)

    ball, radii_m = pressed("")
    assert radii_m == pytest.approx((2.5e-3, 2.5e-3 * 0.8 ** (1 / 3)))
    punch, radii_m = pressed("shape=punch")
    assert radii_m == (2.5e-3, 2.5e-3)
    of_ball, of_punch = 3 / 2.5**2 * (1 - np.arctan(2.5) / 2.5), 1 / (2.5**2 + 1)  # at 1 mm, by Johnson's closed forms
    assert punch / ball == pytest.approx(of_punch / of_ball, rel=0.01)
    assert pressed("adhesion=0.3")[0] / ball == pytest.approx(1.3 - 0.3 * of_punch / of_ball, rel=0.01)
    assert pressed("layer=1000")[0] / ball == pytest.approx(1.0, rel=1e-3)
    assert pressed("layer=2")[0] / ball > 1.05


ROOT = Path(__file__).parents[2]


def test_the_file_is_what_its_script_makes() -> None:
    run = subprocess.run([sys.executable, ROOT / "docs/plates/fingertip400.py"], capture_output=True, check=True)
    assert run.stdout == (ROOT / "resonator_daemon/base/plates/fingertip400.toml").read_bytes()
