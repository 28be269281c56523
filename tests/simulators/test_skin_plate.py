"""The emulated skin plate's tones: signal, noise, phase and gain, read back from its records."""

import numpy as np
import pytest
from tone_fields import counted_fields

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import load_plate
from simulators.contact import pressed_signals
from simulators.scenario import Scenario
from simulators.skin_plate import SkinPlate

GATE_TICKS = 2_500_000
PLATE = load_plate("skin32")
TO_TRIPLE = np.array([3 / (2 * 2e5), 1.0, 1.0])


def count(plate: SkinPlate, frames: int, at_s: float = 1.0, gate_ticks: int = GATE_TICKS) -> dict[str, Floats]:
    return counted_fields(plate, frames, at_s, gate_ticks)


def sigma_hz(fields: dict[str, Floats]) -> Floats:
    return 2 ** ((fields["sigma_code"][0] - 128) / 8)


@pytest.fixture(scope="module")
def still() -> dict[str, Floats]:
    return count(SkinPlate(PLATE, Scenario((), None, PLATE), seed=4), 150)


def test_signal_to_noise_ratio_is_30_db_in_the_triple_at_1_newton(still: dict[str, Floats]) -> None:
    offset_hz = still["offset_hz16"] / 2**16
    weight = sigma_hz(still) ** -2
    combined_hz = (offset_hz * weight).sum(axis=1) / weight.sum(axis=0)
    relative = combined_hz / PLATE.tones.f0_hz[:, 0] / PLATE.tones.sensitivity[:, 0]
    triple_std = relative.std(axis=0, ddof=1) * TO_TRIPLE[PLATE.tones.signal_index]
    signal = pressed_signals(PLATE.site_positions_m, 1e-3, 2e5, 0.5, (0.0, 0.0), 2.5e-3, 0.5, (0.0, 0.0, 1.0))
    signal *= TO_TRIPLE[:, np.newaxis]
    for row in range(3):  # equally noisy rows
        noise = np.sqrt((triple_std[PLATE.tones.signal_index == row] ** 2).mean())
        assert 20 * np.log10(np.sqrt((signal**2).mean()) / noise) == pytest.approx(30.0, abs=0.2)


def test_noise_of_each_corner_is_what_its_code_says(still: dict[str, Floats]) -> None:
    stated = sigma_hz(still)
    found = (still["offset_hz16"] / 2**16).std(axis=0, ddof=1)
    assert np.sqrt(((found / stated) ** 2).mean()) == pytest.approx(1.0, abs=0.01)
    # The code's steps of 1/8 octave, and the scatter of a standard deviation that comes from 150 frames.
    assert (found / stated).std() == pytest.approx(
        np.hypot((2 ** (1 / 16) - 1) / np.sqrt(3), 1 / np.sqrt(298)), rel=0.1
    )
