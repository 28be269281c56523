import math

import numpy as np
import pytest
from small_skin import SITES, TONES, Comb, dimensionless, some_signals

from resonator_daemon.measure.sensors.skin_processing import SkinProcessing

KNOWN = np.ones((4, TONES), dtype=bool)
VARIANCE_HZ2 = np.full((4, TONES), 2.0**-10)


class Skin:
    """A channelised chain fed with frames of whole 2^-16 Hz."""

    def __init__(self, seed=0):
        self.comb, self.rng, self.sequence = Comb(), np.random.default_rng(seed), 0
        self.chain = SkinProcessing(self.comb.array(), gate_s=0.004)

    def push(self, physical, common_mode=2e-5, known=KNOWN):
        self.sequence += 1
        offset = self.comb.offset_hz(physical, common_mode) + 2.0**-5 * self.rng.normal(size=(4, TONES))
        offset_hz16 = np.round(offset * 65_536).astype(np.int32)
        return self.chain.push(self.sequence, 1000 * self.sequence, offset_hz16, np.where(known, VARIANCE_HZ2, np.inf))


NOTHING = np.zeros((3, SITES))


def test_a_skin_learns_its_common_mode_and_gives_signals():
    skin, physical = Skin(), some_signals()
    learning = [skin.push(NOTHING) for _ in range(20)]
    assert [reading.status for reading in learning] == ["settling"] * 19 + ["ok"]
    assert np.isnan(learning[0].signals).all()
    reading = skin.push(physical)
    assert (reading.status, reading.sequence, reading.board_ticks, reading.window_s) == ("ok", 21, 21_000, 0.004)
    assert reading.common_mode == pytest.approx(2e-5, abs=1e-10)
    standardised = (reading.signals - dimensionless(physical)) / reading.noise_std
    assert np.std(standardised) == pytest.approx(1.0, abs=0.15)


def test_a_skin_that_starts_pressed_gives_no_signal_and_says_so():
    skin, physical = Skin(), some_signals()
    for reading in [skin.push(physical) for _ in range(50)]:
        assert reading.status == "pressed_at_start"
        assert np.isnan(reading.signals).all()
        assert math.isnan(reading.common_mode)


def test_a_skins_common_mode_is_held_while_pressed_and_followed_while_not():
    skin, physical = Skin(), some_signals()
    for _ in range(20):
        skin.push(NOTHING)
    held = [skin.push(physical, 2e-5).common_mode for _ in range(100)]
    assert len(set(held)) == 1
    followed = [skin.push(NOTHING, 3e-5).common_mode for _ in range(2000)]
    assert followed[-1] == pytest.approx(3e-5, abs=1e-8)


def test_a_frame_without_a_known_tone_has_no_signal():
    skin = Skin()
    for _ in range(20):
        skin.push(NOTHING)
    reading = skin.push(NOTHING, known=~KNOWN)
    assert reading.status == "no_signal"
    assert np.isnan(reading.signals).all()
    few = ~KNOWN
    few[0, :5] = True
    assert skin.push(NOTHING, known=few).status == "ok"
    fresh = Skin().push(NOTHING, known=few)
    assert fresh.status == "no_signal"
    assert "5 tones" in fresh.reason.text
