"""What a chain says its forces are worth: other tones, beats, drift, warm touches, response, calibration, tare."""

import math

import numpy as np
import pytest
from brute_force_board import GATE_TICKS, REFERENCE_HZ, Board, Channel, Ladder, record_of
from single_tone_bench import CLOCK_ERROR, NO_SIGNAL, PLATE, UNTOUCHED, Bench

from firmware_protocol.layouts import RecordFlag
from resonator_daemon.base.reasons import Reason, ReasonCode

PILOT_DB, TONE_DB = 85.0, 50.0  # below full scale


class _TwoTones(Channel):
    """Edges of the tone that is counted, moved by a weaker one that is `distance_hz` off."""

    jitter_ticks = 0.6
    ratio = 0.0
    distance_hz = 4000.0
    attenuation_db = PILOT_DB

    def gate(self, frequency_hz, end_ticks, flags=0):
        interval = self._stride * REFERENCE_HZ / frequency_hz
        count = int(np.ceil((end_ticks - self._next) / interval))
        ticks = self._next + interval * np.arange(count)
        beat = 2.0 * np.pi * (self.distance_hz * ticks / REFERENCE_HZ)
        ahead_s = np.angle(1.0 + self.ratio * np.exp(1j * beat)) / (2.0 * np.pi * frequency_hz)
        noisy = ticks - ahead_s * REFERENCE_HZ + self._rng.normal(0.0, self.jitter_ticks, count)
        record = record_of(np.floor(noisy).astype(np.int64).tolist(), self._edge, self._stride, flags)
        self._edge += count * self._stride
        self._next += interval * count
        return record._replace(attenuation_db256=round(256 * self.attenuation_db))

    def skip(self, ticks):
        self._next += ticks
        self._edge += round(ticks / 100.0)


class TwoToneBoard(Board):
    def __init__(self, seed=0):
        super().__init__(seed)
        for channel in self._channels:
            channel.__class__ = _TwoTones

    def hear(self, **state):
        """Set what channels hear, of each keyword one value for all or four."""
        for name, values in state.items():
            for channel, value in zip(self._channels, np.broadcast_to(values, 4).tolist(), strict=True):
                setattr(channel, name, value)

    def skip(self, frames):
        """Let time go by in which nobody counts."""
        self.sequence += frames
        self.board_ticks += frames * GATE_TICKS
        for channel in self._channels:
            channel.skip(frames * GATE_TICKS)


def heard(*, level_db=TONE_DB, **state):
    """A bench at a board that was untouched until now and hears these second tones from now on."""
    bench = Bench(board=TwoToneBoard())
    bench.board.hear(attenuation_db=PILOT_DB)
    bench.untouched()
    bench.board.hear(attenuation_db=level_db, **state)
    return bench


@pytest.mark.parametrize("ratio", [[0.6, 0.0, 0.0, 0.0], [0.3, 0.4, 0.3, 0.5]])
def test_a_second_touch_that_is_weaker_at_every_corner_is_possibly_more(ratio):
    readings = heard(ratio=ratio).hold(PLATE.loaded_hz(3, 2.0), 60)[4:]
    assert {(reading.status, reading.reason.code) for reading in readings} == {
        ("possibly_more", ReasonCode.SECOND_TONE)
    }
    for reading in readings:
        (force,) = reading.sites
        assert (force.site, force.status) == (3, "possibly_more")
        assert force.force_newton == pytest.approx(2.0, abs=6 * force.noise_newton)
    assert readings[-1].contacts[0].touch.status == "possibly_more"


def test_a_touch_alone_is_not_possibly_more_though_the_pilot_goes_on():
    pilot = 10 ** ((TONE_DB - PILOT_DB) / 20)
    assert {reading.status for reading in heard(ratio=pilot).hold(PLATE.loaded_hz(3, 2.0), 200)[4:]} == {"ok"}
    # Where the touched tone is hardly stronger, the pilot moves it as a second touch would, and is known to.
    faint = heard(ratio=0.5, level_db=PILOT_DB - 6.0)
    assert {reading.status for reading in faint.hold(PLATE.loaded_hz(3, 0.1), 200)[4:]} == {"ok"}


def test_the_beat_of_a_second_tone_counts_as_noise():
    beating, alone = (
        heard(ratio=ratio, distance_hz=2370.0).hold(PLATE.loaded_hz(3, 2.0), 200)[10:] for ratio in (0.6, 0.0)
    )
    error = [reading.sites[0].force_newton - 2.0 for reading in beating]
    noise = [reading.sites[0].noise_newton for reading in beating]
    assert np.std(error) < 3 * np.mean(noise)
    assert np.mean(noise) > 1.2 * np.mean([reading.sites[0].noise_newton for reading in alone])


CAPTURE_SWITCH = int(RecordFlag.CAPTURE_SWITCH)


def test_a_channel_that_hears_two_tones_alike_is_named_and_the_touch_possibly_more():
    bench = Bench().untouched()
    site_hz = PLATE.loaded_hz(3, 2.0)
    bench.hold(site_hz, 43)  # so that the second of two such frames is at a step
    once = bench.hold(site_hz, 2, (0, CAPTURE_SWITCH, 0, 0)) + bench.hold(site_hz, 20)
    assert {reading.status for reading in once} == {"ok"}
    crowded = bench.hold(site_hz, 20, (0, CAPTURE_SWITCH, 0, 0))
    reason = crowded[-1].reason
    assert (crowded[-1].status, reason.code) == ("possibly_more", ReasonCode.TONES_ALIKE)
    assert "channel 1" in reason.text
    (force,) = crowded[-1].sites
    assert (force.site, force.status, force.channels) == (3, "possibly_more", (0, 2, 3))
    assert force.force_newton == pytest.approx(2.0, abs=0.02)
    assert bench.hold(site_hz, 40)[-1].status == "ok"


def test_where_no_channel_has_a_strongest_tone_no_site_is_named():
    bench = Bench().untouched()
    crowded = bench.hold(PLATE.loaded_hz(3, 2.0), 40, (CAPTURE_SWITCH,) * 4)
    assert (crowded[-1].status, crowded[-1].sites, crowded[-1].contacts) == ("rejected", (), ())
    assert crowded[-1].reason.code == ReasonCode.TONES_ALIKE


def test_a_board_whose_stamps_do_not_run_on_from_gate_to_gate_gives_no_force():
    bench = Bench().untouched()
    readings = bench.hold(PLATE.loaded_hz(3, 2.0), 200, (int(RecordFlag.STRIDE_BREAK),) * 4)
    assert all(reading.sites == () for reading in readings[1:])


def test_a_board_that_measures_no_level_gives_the_same_forces_and_a_larger_noise():
    site_hz = PLATE.loaded_hz(3, 2.0)
    measured = heard(level_db=PILOT_DB - 20.0).hold(site_hz, 60)[-1]
    constant = heard(level_db=PILOT_DB).hold(site_hz, 60)[-1]
    (found,), (expected,) = constant.sites, measured.sites
    assert found.force_newton == pytest.approx(expected.force_newton, abs=expected.noise_newton)
    assert expected.noise_newton < found.noise_newton < 2.0 * expected.noise_newton


@pytest.mark.parametrize("odd", range(4))
def test_one_channel_that_another_tone_has_captured_is_left_out(odd):
    bench = Bench().untouched()
    frequency = PLATE.loaded_hz(3, 2.0)
    frequency[odd] = 9.9935e6  # between two codes
    last = bench.hold(frequency, 40)[-1]
    (force,) = last.sites
    assert force.site == 3
    assert force.channels == tuple(channel for channel in range(4) if channel != odd)
    assert force.force_newton == pytest.approx(2.0, abs=0.02)
    assert last.status == "ok"
    assert last.reason == Reason(ReasonCode.CHANNEL_LEFT_OUT, f"channel {odd} detects another tone")


def beating(jitter_ticks, interval_ticks):
    """The reading of a site whose every hundredth edge is so many ticks after the one before."""
    plate = Ladder(pull=0.0)
    site = int(np.flatnonzero(plate.code == 10)[0])
    loaded_hz = plate.loaded_hz(site, 2.0)
    bench = Bench(plate, board=TwoToneBoard(), error=100.0 * REFERENCE_HZ / interval_ticks / loaded_hz[0] - 1.0)
    bench.board.hear(attenuation_db=PILOT_DB)
    bench.untouched()
    bench.board.hear(attenuation_db=TONE_DB, jitter_ticks=jitter_ticks)
    reading = bench.hold(loaded_hz, 40)[-1]
    assert (reading.status, reading.sites[0].site) == ("ok", site)
    return reading


def test_a_tone_in_step_with_the_reference_is_named_and_its_noise_counts_for_more():
    # Without jitter all stamps are off by the same part of a tick, which the next gates' are not.
    in_step, apart, noisy = beating(0.0, 10_040.0), beating(0.0, 10_040.0618), beating(0.6, 10_040.0)
    assert in_step.beats == (0, 1, 2, 3)
    assert apart.beats == ()
    assert noisy.beats == ()
    assert in_step.sites[0].noise_newton > 3 * noisy.sites[0].noise_newton


def test_a_held_baseline_grows_less_certain():
    bench = Bench(board=TwoToneBoard()).untouched()
    site_hz = PLATE.loaded_hz(5, 1.0)
    first = bench.hold(site_hz, 40)[-1]
    bench.board.skip(900_000)
    last = bench.hold(site_hz, 40)[-1]
    assert (first.compensation.baseline, last.compensation.baseline) == ("held", "held")
    # A random walk of 1e-8 after a second is 3e-7 after a quarter of an hour.
    k = abs(PLATE.sensitivity[5, 0])
    grown = math.sqrt(last.sites[0].systematic_newton ** 2 - first.sites[0].systematic_newton ** 2)
    assert grown == pytest.approx(3e-7 / k, rel=0.02)
    assert last.compensation.common_mode_std > first.compensation.common_mode_std
    assert bench.hold(UNTOUCHED, 200)[-1].compensation.baseline == "followed"
    again = bench.hold(site_hz, 40)[-1]
    assert again.sites[0].systematic_newton == pytest.approx(first.sites[0].systematic_newton, rel=0.01)


def test_a_plate_is_tared_only_while_it_is_untouched():
    bench = Bench(error=CLOCK_ERROR)
    assert "not detected" in bench.chain.tare()
    bench.hold(UNTOUCHED, 15)
    assert bench.readings[-1].status == "settling"
    assert bench.chain.tare() is None
    assert bench.hold(UNTOUCHED, 5)[-1].status == "ok"  # at once, not after twenty readings
    assert bench.chain.compensation.common_mode == pytest.approx([CLOCK_ERROR] * 4, abs=3e-8)
    before = bench.hold(PLATE.loaded_hz(3, 2.0), 40)[-1].compensation.common_mode
    assert "touched" in bench.chain.tare()
    last = bench.hold(PLATE.loaded_hz(3, 2.0), 40)[-1]
    assert last.compensation.common_mode == before
    assert last.sites[0].force_newton == pytest.approx(2.0, abs=0.02)


def test_windows_that_are_still_short_do_not_teach_the_common_mode():
    bench = Bench().untouched()
    before = bench.chain.compensation.common_mode
    for _ in range(20):
        bench.lose(UNTOUCHED, 1)
        bench.hold(UNTOUCHED, 5)
    assert bench.chain.compensation.common_mode == before
    bench.hold(UNTOUCHED, 20)
    assert bench.chain.compensation.common_mode != before


def test_a_silent_channel_keeps_a_plate_from_being_tared():
    bench = Bench().untouched()
    bench.hold(UNTOUCHED, 40, (0, 0, NO_SIGNAL, 0))
    assert "channels are silent" in bench.chain.tare()


def test_noise_of_the_oscillators_is_measured_at_rest():
    noise = []
    for allan_deviation in (3e-10, 9e-10):
        bench, rng = Bench().untouched(), np.random.default_rng(5)
        of_gates = allan_deviation / np.sqrt(GATE_TICKS / REFERENCE_HZ) * rng.standard_normal((4000, 1))
        bench.play(UNTOUCHED * (1.0 + of_gates))
        noise.append(bench.hold(PLATE.loaded_hz(3, 2.0), 60)[-1].sites[0].noise_newton)
    assert 1.5 < noise[1] / noise[0] < 2.4  # 2.46 for the oscillators after 4 s; the counter has noise, too
