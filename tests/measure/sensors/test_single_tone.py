"""Frames to forces and contacts: what a chain tells of touches, gaps, silent corners and impossible records."""

import itertools
import math

import numpy as np
import pytest
from brute_force_board import GATE_TICKS, Ladder, payload_of
from single_tone_bench import CLOCK_ERROR, NO_SIGNAL, PLATE, UNTOUCHED, Bench, events

from firmware_protocol.layouts import SingleToneRecord
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.clock import Line, TickScale
from resonator_daemon.board.session.frames import SingleToneFrame

SCALE = TickScale(10**12, 0, Line(0, 0, 0.0, 0.0, 0.0), 0, 0)
NONSENSE = SingleToneRecord(0, 0, 65_535, 65_535, 2**32 - 1, 2**64 - 1, 2**64 - 1, 2**64 - 1, 65_535, 0)


def test_readings_come_at_step_boundaries_with_the_windows_end():
    bench = Bench(step_frames=4)
    given = [bool(bench.push(*bench.board.frame(UNTOUCHED))) for _ in range(12)]
    assert given == [False, False, False, True] * 3
    reading = bench.hold(UNTOUCHED, 4)[0]
    assert (reading.sequence, reading.board_ticks) == (15, bench.board.board_ticks)
    assert reading.window_s == pytest.approx(0.01)


@pytest.mark.parametrize("error", [0.0, CLOCK_ERROR, -CLOCK_ERROR])
@pytest.mark.parametrize("mixed_sign", [False, True])
def test_a_press_gives_force_site_and_contact_whatever_the_clock_error(error, mixed_sign):
    plate = Ladder(mixed_sign=mixed_sign)
    bench = Bench(plate, error=error).untouched()
    for site in range(0, 16, 3):
        pressed = bench.hold(plate.loaded_hz(site, 2.5), 40)
        assert events(pressed) == [("onset", site)]
        last = pressed[-1]
        assert last.status == "ok"
        assert [force.site for force in last.sites] == [site]
        assert abs(last.sites[0].force_newton - 2.5) < 6 * last.sites[0].noise_newton < 0.02
        (contact,) = last.contacts
        assert contact.touch.force_newton == last.sites[0].force_newton
        assert contact.touch.position_m == pytest.approx(tuple(plate.positions_m[site]))
        released = bench.hold(UNTOUCHED, 40)
        assert events(released) == [("release", site)]
        assert released[-1].contacts == ()
    assert last.compensation.common_mode == pytest.approx([error] * 4, abs=3e-8)


@pytest.mark.parametrize("phase", range(5))
def test_an_onset_is_reported_at_once_between_two_steps(phase):
    bench = Bench().untouched()
    bench.hold(UNTOUCHED, phase)
    captured_ticks = bench.board.board_ticks
    readings = [reading for reading in bench.hold(PLATE.loaded_hz(3, 1.0), 20) if reading.events]
    assert events(readings) == [("onset", 3)]
    assert readings[0].board_ticks - captured_ticks <= 4 * GATE_TICKS
    assert readings[0].at_step == ((readings[0].sequence + 1) % 5 == 0)
    assert readings[0].contacts[0].touch.force_newton == pytest.approx(1.0, abs=6 * readings[0].sites[0].noise_newton)


def test_a_new_touch_is_followed_by_a_window_that_grows_from_two_gates_to_ten():
    bench = Bench(step_frames=1).untouched()
    readings = bench.hold(PLATE.loaded_hz(3, 1.0), 20)
    measured = [reading for reading in readings if reading.sites]
    assert [round(1000 * reading.window_s) for reading in measured[:10]] == [2, 3, 4, 5, 6, 7, 8, 9, 10, 10]
    noise = [reading.sites[0].noise_newton for reading in measured]
    assert all(later < 1.2 * earlier for earlier, later in itertools.pairwise(noise))
    assert noise[0] > 5 * noise[9]


def test_tones_of_the_corners_are_those_of_the_sites_that_each_captured():
    bench = Bench(error=CLOCK_ERROR, tones_period_frames=50).untouched()
    two_hz = np.where([True, True, False, False], PLATE.loaded_hz(3, 2.5), PLATE.loaded_hz(9, 1.0))
    for true_hz, sites in ((UNTOUCHED, [None] * 4), (PLATE.loaded_hz(6, 1.5), [6] * 4), (two_hz, [3, 3, 9, 9])):
        tones = [reading.tones for reading in bench.hold(true_hz, 200) if reading.tones]
        assert len(tones) == 4  # of 40 readings
        assert [tone.site for tone in tones[-1]] == sites
        for tone, hz in zip(tones[-1], true_hz, strict=True):
            assert abs(tone.frequency_hz - hz) < 6 * tone.noise_hz < 1.0
            assert (tone.captured == "pilot") == math.isnan(tone.residual)
            assert not abs(tone.residual) > 4
    silent = [reading.tones for reading in bench.hold(two_hz, 50, (NO_SIGNAL, 0, 0, 0)) if reading.tones][-1][0]
    assert (silent.captured, silent.site, silent.reason_code) == ("none", None, ReasonCode.CHANNELS_SILENT)


def test_a_gap_restarts_the_windows_and_keeps_the_contact():
    bench = Bench().untouched()
    site_hz = PLATE.loaded_hz(6, 1.5)
    before = bench.hold(site_hz, 40)[-1].contacts[0]
    bench.lose(site_hz, 101)
    after = bench.hold(site_hz, 40)
    assert after[0].window_s < 0.01 == after[-1].window_s  # the window grows anew
    assert events(after) == []
    assert after[-1].contacts[0].id == before.id
    assert after[-1].contacts[0].since_ticks == before.since_ticks
    assert after[-1].sites[0].force_newton == pytest.approx(1.5, abs=0.02)


@pytest.mark.parametrize("pull", [0.0, 25e-6])
def test_no_ramp_to_80_newton_ever_gives_a_plausible_number(pull):
    plate = Ladder(pull=pull)
    rising = np.arange(0.0, 80.0, 0.25)
    for site in (0, 10):
        bench = Bench(plate, step_frames=2, window_frames=4).untouched()
        ramp = [plate.loaded_hz(site, force) for force in np.concatenate([rising, rising[::-1]])]
        readings = bench.play(ramp)
        overloads = 0
        for reading in readings:
            frame = reading.sequence - 200
            window = np.concatenate([rising, rising[::-1]])[max(frame - 3, 0) : frame + 1]
            for force in reading.sites:
                assert force.site == site
                if force.status == "overload":
                    overloads += 1
                    assert math.isnan(force.force_newton)
                    assert force.at_least_newton == 10.0
                    assert window.max() > 9.5
                else:
                    assert window.min() - 0.2 < force.force_newton < window.max() + 0.2
        assert overloads > 200
        assert events(readings) == [("onset", site)]
        assert readings[-1].contacts[0].peak_newton == 10.0


def test_frames_missing_by_number_restart_the_windows_even_where_the_stamps_run_on():
    bench = Bench().untouched()
    for _ in range(10):
        sequence, ticks, records = bench.board.frame(PLATE.loaded_hz(6, 1.5))
        readings = bench.push(sequence, ticks, records)
    (reading,) = readings
    assert reading.status == "ok"
    for _ in range(5):
        sequence, ticks, records = bench.board.frame(PLATE.loaded_hz(6, 1.5))
        readings = bench.push(sequence + 10, ticks, records)
    (reading,) = readings
    assert reading.window_s == pytest.approx(0.005)


def test_a_channel_without_signal_is_left_out_and_counted():
    bench = Bench().untouched()
    before = bench.chain.unusable.copy()
    last = bench.hold(PLATE.loaded_hz(2, 1.0), 40, (0, NO_SIGNAL, 0, 0))[-1]
    assert last.status == "ok"
    assert last.sites[0].force_newton == pytest.approx(1.0, abs=0.02)
    assert last.sites[0].channels == (0, 2, 3)
    assert bench.chain.unusable - before == {"no_signal": 40}
    assert events(bench.hold(UNTOUCHED, 40, (0, NO_SIGNAL, 0, 0))) == [("release", 2)]


@pytest.mark.parametrize(
    ("dead", "pressed", "status"),
    [
        ((1, 1, 1, 1), False, "no_signal"),
        ((1, 1, 1, 0), False, "pilot_lost"),
        ((1, 1, 0, 0), False, "ok"),
        ((1, 1, 1, 0), True, "rejected"),
        ((1, 1, 0, 0), True, "ok"),
    ],
)
def test_what_few_channels_can_tell(dead, pressed, status):
    bench = Bench().untouched()
    frequency = PLATE.loaded_hz(2, 1.0) if pressed else UNTOUCHED
    last = bench.hold(frequency, 40, [NO_SIGNAL * d for d in dead])[-1]
    assert last.status == status
    assert len(last.sites) == (pressed and status == "ok")
    if status not in ("ok", "rejected"):
        assert last.reason.code == ReasonCode.CHANNELS_SILENT


def test_a_corner_that_is_dead_from_the_start_is_named_and_left_out():
    bench = Bench()
    flags = (0, 0, NO_SIGNAL, 0)
    last = bench.hold(UNTOUCHED, 300, flags)[-1]
    assert (last.status, last.reason) == ("ok", Reason(ReasonCode.CHANNELS_SILENT, "channel 2: no signal"))
    assert math.isnan(last.compensation.common_mode[2])
    pressed = bench.hold(PLATE.loaded_hz(2, 1.0), 40, flags)[-1]
    assert [(force.site, force.channels) for force in pressed.sites] == [(2, (0, 1, 3))]
    assert pressed.sites[0].force_newton == pytest.approx(1.0, abs=0.02)


def test_impossible_records_are_counted_and_never_a_force():
    bench = Bench().untouched()
    bench.chain.unusable.clear()
    for _ in range(100):
        sequence, ticks, _ = bench.board.frame(PLATE.loaded_hz(2, 1.0))
        for reading in bench.push(sequence, ticks, [NONSENSE] * 4):
            assert reading.sites == ()
            assert reading.status != "ok"
    assert bench.chain.unusable.total() == 400
    assert set(bench.chain.unusable) == {"impossible_counts"}
    assert bench.hold(PLATE.loaded_hz(2, 1.0), 40)[-1].sites[0].force_newton == pytest.approx(1.0, abs=0.02)


def eventful_frames():
    """Frames of touches, two at once, changing levels, gaps, silence, capture switches, stride breaks and nonsense."""
    rng, board, frames = np.random.default_rng(4), Bench().board, []
    split = np.where([True, True, False, False], PLATE.loaded_hz(2, 1.0), PLATE.loaded_hz(9, 2.0))
    for hertz in (UNTOUCHED, PLATE.loaded_hz(3, 1.0), PLATE.loaded_hz(8, 20.0), UNTOUCHED, split, UNTOUCHED) * 3:
        for number in range(int(rng.integers(100, 250))):
            flags = rng.choice([0, NO_SIGNAL, 8, 32], 4, p=[0.9985, 0.0005, 0.0005, 0.0005])
            sequence, ticks, records = board.frame(hertz, flags.tolist())
            level = int(rng.integers(2048))  # in 1/256 dB
            records = [record._replace(attenuation_db256=level) for record in records]
            if rng.random() < 0.003:
                records[3] = NONSENSE
            if number < 50 or rng.random() > 0.005:
                frames.append((sequence, ticks, records))
    return frames


@pytest.mark.parametrize("window_frames", [pytest.param(2, marks=pytest.mark.soak), 10, 30])
def test_how_frames_are_cut_into_blocks_changes_no_reading(window_frames):
    frames, rng = eventful_frames(), np.random.default_rng(5)
    one_by_one, in_blocks = (Bench(window_frames=window_frames, step_frames=min(5, window_frames)) for _ in range(2))
    expected = [reading for frame in frames for reading in one_by_one.push(*frame)]
    seen = []
    while frames:
        most = int(rng.choice([1, 5, 64, 700]))
        adjacent = [frame for at, frame in enumerate(frames[:most]) if frame[0] == frames[0][0] + at]
        seen += in_blocks.chain.process(
            [SingleToneFrame(index, ticks, ticks, SCALE, payload_of(records)) for index, ticks, records in adjacent]
        )
        del frames[: len(adjacent)]
    assert repr(seen) == repr(expected)
    assert {"ok", "overload", "settling"} <= {reading.status for reading in seen}
    assert in_blocks.chain.unusable == one_by_one.chain.unusable
