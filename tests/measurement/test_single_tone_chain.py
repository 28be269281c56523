import itertools
import math

import numpy as np
import pytest
from brute_force_board import GATE_TICKS, PILOT_HZ, REFERENCE_HZ, Board, Ladder
from two_tone_board import PILOT_DB, TONE_DB, TwoToneBoard

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.force_sites import ForceSites, Warmth
from resonator_daemon.measurement.single_tone_chain import SingleToneChain
from resonator_daemon.measurement.site_response import SiteResponse

PLATE = Ladder()
UNTOUCHED = np.full(4, PILOT_HZ)
CLOCK_ERROR = 3e-5


class Bench:
    """A chain fed by a board, with the readings it gave."""

    def __init__(
        self,
        plate=PLATE,
        *,
        window_frames=10,
        step_frames=5,
        seed=0,
        exponent=None,
        error=0.0,
        contact_std_kelvin=0.0,
        slope=0.0,
        board=None,
        **calibration,
    ):
        self.board = board or Board(seed)
        self.error = error
        self.readings = []
        warmth = Warmth(np.tile([slope, 0.0, 0.0], (16, 1)), 0.0, -2e-7, np.full(16, contact_std_kelvin), 5.0)
        sites = ForceSites(
            plate.f0_hz,
            plate.sensitivity,
            plate.positions_m,
            plate.outline_m,
            plate.force_max_newton,
            warmth,
            0.015,
            **calibration,
        )
        self.chain = SingleToneChain(
            sites,
            pilot_hz=PILOT_HZ,
            reference_hz=REFERENCE_HZ,
            gate_s=GATE_TICKS / REFERENCE_HZ,
            window_frames=window_frames,
            step_frames=step_frames,
            load_sharing_exponent=exponent,
        )

    def hold(self, frequency_hz, frames, flags=(0, 0, 0, 0)):
        """Let the board count these frequencies for a while; returns the readings of that time."""
        return self.play([frequency_hz] * frames, flags)

    def play(self, frequencies, flags=(0, 0, 0, 0)):
        before = len(self.readings)
        for frequency in frequencies:
            reading = self.chain.push(*self.board.frame(np.asarray(frequency) * (1 + self.error), flags))
            if reading:
                self.readings.append(reading)
        return self.readings[before:]

    def lose(self, frequency_hz, frames):
        for _ in range(frames):
            self.board.frame(np.asarray(frequency_hz) * (1 + self.error))

    def untouched(self):
        """Hear the pilot until the common mode is known."""
        assert self.hold(UNTOUCHED, 200)[-1].status == "ok"
        return self


def events(readings):
    return [(event.event, event.contact.touch.site) for reading in readings for event in reading.events]


def test_readings_come_at_step_boundaries_with_the_windows_end():
    bench = Bench(step_frames=4)
    given = [bench.chain.push(*bench.board.frame(UNTOUCHED)) is not None for _ in range(12)]
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
def test_an_onset_is_told_at_once_between_two_steps(phase):
    bench = Bench().untouched()
    bench.hold(UNTOUCHED, phase)
    captured_ticks = bench.board.board_ticks
    told = [reading for reading in bench.hold(PLATE.loaded_hz(3, 1.0), 20) if reading.events]
    assert events(told) == [("onset", 3)]
    assert told[0].board_ticks - captured_ticks <= 4 * GATE_TICKS
    assert told[0].at_step == ((told[0].sequence + 1) % 5 == 0)
    assert told[0].contacts[0].touch.force_newton == pytest.approx(1.0, abs=6 * told[0].sites[0].noise_newton)


def test_what_comes_between_two_steps_brings_events_and_nothing_else():
    bench = Bench().untouched()
    readings = bench.hold(PLATE.loaded_hz(3, 1.0), 41) + bench.hold(UNTOUCHED, 41)
    between = [reading for reading in readings if not reading.at_step]
    assert all(reading.events for reading in between)
    assert [(reading.sequence + 1) % 5 for reading in readings if reading.at_step] == [0] * 16


def test_a_new_touch_is_followed_by_a_window_that_grows_from_two_gates_to_ten():
    bench = Bench(step_frames=1).untouched()
    readings = bench.hold(PLATE.loaded_hz(3, 1.0), 20)
    measured = [reading for reading in readings if reading.sites]
    assert [round(1000 * reading.window_s) for reading in measured[:10]] == [2, 3, 4, 5, 6, 7, 8, 9, 10, 10]
    noise = [reading.sites[0].noise_newton for reading in measured]
    assert all(later < 1.2 * earlier for earlier, later in itertools.pairwise(noise))
    assert noise[0] > 5 * noise[9]


def test_no_window_mixes_two_tones():
    # A capture switch that is not flagged, at every phase of the step: no force but the true one is ever given.
    for phase in range(5):
        bench = Bench().untouched()
        bench.hold(UNTOUCHED, phase)
        for reading in bench.hold(PLATE.loaded_hz(4, 3.0), 30) + bench.hold(PLATE.loaded_hz(8, 1.0), 30):
            for force in reading.sites:
                assert force.force_newton == pytest.approx({4: 3.0, 8: 1.0}[force.site], abs=0.03)


def test_a_chain_that_starts_pressed_says_so_and_gives_no_force():
    bench = Bench(error=CLOCK_ERROR)
    pressed = bench.hold(PLATE.loaded_hz(3, 2.0), 300)
    assert {reading.status for reading in pressed[2:]} == {"pressed_at_start"}
    assert all(reading.sites == () and reading.contacts == () for reading in pressed)
    assert all(math.isnan(g) for g in pressed[-1].compensation.common_mode)
    released = bench.hold(UNTOUCHED, 200)
    assert released[-1].status == "ok"
    assert bench.hold(PLATE.loaded_hz(3, 2.0), 40)[-1].sites[0].force_newton == pytest.approx(2.0, abs=0.02)


def test_a_reboot_while_pressed_gives_no_force_until_the_pilot_is_heard():
    bench = Bench().untouched()
    assert bench.hold(PLATE.loaded_hz(3, 2.0), 40)[-1].sites
    ended = bench.chain.restart()
    assert [(event.event, event.contact.touch.site) for event in ended] == [("release", 3)]
    pressed = bench.hold(PLATE.loaded_hz(3, 2.0), 300)
    assert pressed[-1].status == "pressed_at_start"
    assert all(reading.sites == () and reading.contacts == () for reading in pressed)


def test_a_restart_before_the_first_frame_has_nothing_to_release():
    assert Bench().chain.restart() == ()


def test_a_held_press_is_never_tared_away():
    bench = Bench().untouched()
    pressed = bench.hold(PLATE.loaded_hz(5, 1.0), 3000)
    assert pressed[-1].sites[0].force_newton == pytest.approx(1.0, abs=0.01)
    assert pressed[-1].compensation.common_mode == pressed[0].compensation.common_mode


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


def test_a_gap_longer_than_half_a_second_ends_the_contact():
    bench = Bench().untouched()
    bench.hold(PLATE.loaded_hz(6, 1.5), 40)
    bench.lose(PLATE.loaded_hz(6, 1.5), 600)
    after = bench.hold(PLATE.loaded_hz(6, 1.5), 40)
    assert events(after) == [("release", 6), ("onset", 6)]


@pytest.mark.parametrize("pull", [0.0, 25e-6])
def test_no_ramp_to_80_newton_ever_gives_a_plausible_number(pull):
    plate = Ladder(pull=pull)
    rising = np.arange(0.0, 80.0, 0.25)
    for site in (0, 5, 10):
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


def test_an_overload_ends_with_the_pilot():
    bench = Bench().untouched()
    assert bench.hold(PLATE.loaded_hz(6, 20.0), 40)[-1].status == "overload"
    bench.hold(UNTOUCHED, 40)
    last = bench.hold(PLATE.loaded_hz(2, 1.0), 40)[-1]
    assert (last.status, last.sites[0].site) == ("ok", 2)


def test_frames_missing_by_number_restart_the_windows_even_where_the_stamps_run_on():
    bench = Bench().untouched()
    for _ in range(10):
        sequence, ticks, records = bench.board.frame(PLATE.loaded_hz(6, 1.5))
        reading = bench.chain.push(sequence, ticks, records)
    assert reading.status == "ok"
    for _ in range(5):
        sequence, ticks, records = bench.board.frame(PLATE.loaded_hz(6, 1.5))
        reading = bench.chain.push(sequence + 10, ticks, records)
    assert reading.window_s == pytest.approx(0.005)


def test_corners_that_still_hear_the_pilot_are_left_out():
    bench = Bench().untouched()
    light = np.where([True, False, True, False], PLATE.loaded_hz(2, 0.05), UNTOUCHED)
    last = bench.hold(light, 40)[-1]
    assert last.status == "ok"
    assert [force.site for force in last.sites] == [2]
    assert last.sites[0].force_newton == pytest.approx(0.05, abs=0.01)


def test_two_touches_that_split_the_corners_are_both_given():
    bench = Bench().untouched()
    split = np.where([True, True, False, False], PLATE.loaded_hz(2, 1.0), PLATE.loaded_hz(9, 2.0))
    last = bench.hold(split, 40)[-1]
    assert (last.status, last.reason) == ("ok", "channels hear different sites")
    assert {force.site: round(force.force_newton, 2) for force in last.sites} == {2: 1.0, 9: 2.0}
    assert {contact.touch.site for contact in last.contacts} == {2, 9}


def test_load_sharing_bounds_what_is_hidden_and_changes_nothing_else():
    plain = Bench().untouched().hold(PLATE.loaded_hz(2, 1.0), 40)[-1].sites[0]
    shared = Bench(exponent=4.0).untouched().hold(PLATE.loaded_hz(2, 1.0), 40)[-1].sites[0]
    assert shared.force_newton == plain.force_newton
    assert shared.noise_newton == plain.noise_newton
    assert shared.systematic_newton == plain.systematic_newton
    assert shared.hidden_newton > 0.5 > plain.hidden_newton == 0.0


NO_SIGNAL = int(RecordFlag.NO_SIGNAL)


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
        assert "channel 0: no_signal" in last.reason


def test_a_corner_that_is_dead_from_the_start_is_named_and_left_out():
    bench = Bench()
    flags = (0, 0, NO_SIGNAL, 0)
    last = bench.hold(UNTOUCHED, 300, flags)[-1]
    assert (last.status, last.reason) == ("ok", "channel 2: no_signal")
    assert math.isnan(last.compensation.common_mode[2])
    pressed = bench.hold(PLATE.loaded_hz(2, 1.0), 40, flags)[-1]
    assert [(force.site, force.channels) for force in pressed.sites] == [(2, (0, 1, 3))]
    assert pressed.sites[0].force_newton == pytest.approx(1.0, abs=0.02)


def test_one_corner_alone_gives_no_force():
    bench = Bench()
    flags = (NO_SIGNAL, NO_SIGNAL, NO_SIGNAL, 0)
    assert bench.hold(UNTOUCHED, 300, flags)[-1].status == "pilot_lost"
    assert bench.hold(PLATE.loaded_hz(2, 1.0), 40, flags)[-1].sites == ()


def test_the_first_readings_settle():
    readings = Bench().hold(UNTOUCHED, 30)
    assert {reading.status for reading in readings} == {"settling"}
    assert "being learnt" in readings[0].reason
    assert "common mode" in readings[-1].reason


@pytest.mark.parametrize(
    "record",
    [
        SingleToneRecord(*[0] * 10),
        SingleToneRecord(0, 0, 65_535, 65_535, 2**32 - 1, 2**64 - 1, 2**64 - 1, 2**64 - 1, 65_535, 0),
        SingleToneRecord(0, 0, 100, 100, 990_000, 49_500_000, 2**62, 0, 0, 0),
        SingleToneRecord(5, 5, 1, 10, 0, 0, 0, 0, 0, 0),
    ],
)
def test_impossible_records_are_counted_and_never_a_force(record):
    bench = Bench().untouched()
    bench.chain.unusable.clear()
    for _ in range(100):
        sequence, ticks, _ = bench.board.frame(PLATE.loaded_hz(2, 1.0))
        reading = bench.chain.push(sequence, ticks, [record] * 4)
        if reading:
            assert reading.sites == ()
            assert reading.status != "ok"
    assert bench.chain.unusable.total() == 400
    assert set(bench.chain.unusable) == {"impossible_counts"}
    assert bench.hold(PLATE.loaded_hz(2, 1.0), 40)[-1].sites[0].force_newton == pytest.approx(1.0, abs=0.02)


def test_a_wrong_number_of_records_is_refused():
    with pytest.raises(ValueError, match="3 records"):
        Bench().chain.push(0, 0, [SingleToneRecord(*[0] * 10)] * 3)


def test_a_step_of_no_frames_is_refused():
    with pytest.raises(ValueError, match="0 frames"):
        Bench(step_frames=0)


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
    assert {(reading.status, reading.reason) for reading in readings} == {
        ("possibly_more", "more than the counted tone is heard")
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
    assert (crowded[-1].status, crowded[-1].reason) == (
        "possibly_more",
        "two tones are alike: channel 1: capture_switch",
    )
    (force,) = crowded[-1].sites
    assert (force.site, force.status, force.channels) == (3, "possibly_more", (0, 2, 3))
    assert force.force_newton == pytest.approx(2.0, abs=0.02)
    assert bench.hold(site_hz, 40)[-1].status == "ok"


def test_where_no_channel_has_a_strongest_tone_no_site_is_named():
    bench = Bench().untouched()
    crowded = bench.hold(PLATE.loaded_hz(3, 2.0), 40, (CAPTURE_SWITCH,) * 4)
    assert (crowded[-1].status, crowded[-1].sites, crowded[-1].contacts) == ("rejected", (), ())
    assert "no tone is the strongest for long: channel 0: capture_switch" in crowded[-1].reason


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
    assert (last.status, last.reason) == ("ok", f"channel {odd} hears another tone")


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


def test_a_touch_that_may_be_warm_is_less_certain_the_longer_it_lasts():
    k = abs(PLATE.sensitivity[5, 0])
    grown = []
    for held_frames in (0, 5000, 30_000):
        warm, cold = (
            Bench(board=TwoToneBoard(), slope=-3e-7, contact_std_kelvin=kelvin).untouched() for kelvin in (3.0, 0.0)
        )
        for bench in (warm, cold):
            bench.hold(PLATE.loaded_hz(5, 1.0), 40)
            bench.board.skip(held_frames)
            bench.hold(PLATE.loaded_hz(5, 1.0), 40)
        both = [bench.readings[-1].sites[0].systematic_newton for bench in (warm, cold)]
        grown.append(math.sqrt(both[0] ** 2 - both[1] ** 2) * k)
    # 3 K (1 - exp(-t / 5 s)) times the slope, less the transient's 2e-7 s times the rate.
    static = [3.0 * 3e-7 * (1 - math.exp(-t / 5.0)) for t in (0.08, 5.08, 30.08)]
    transient = [3.0 * 2e-7 / 5.0 * math.exp(-t / 5.0) for t in (0.08, 5.08, 30.08)]
    assert grown == pytest.approx(np.add(static, transient), rel=0.03, abs=2e-9)


PLAY_NEWTON = 0.1


def pressed_and_let_go(bench):
    """Load a site that has a play to 6 N and back to 2 N; returns what is said of it while it goes back."""
    z, frequencies = 0.0, []
    for newton in np.concatenate([np.linspace(0.05, 6.0, 100), np.linspace(6.0, 2.0, 100), np.full(20, 2.0)]):
        z = min(max(z, newton - PLAY_NEWTON), newton + PLAY_NEWTON)
        frequencies.append(PLATE.loaded_hz(5, (newton + z) / 2))
    return bench.play(frequencies)[-2].sites[0]


def test_hysteresis_that_was_calibrated_is_taken_out_and_said_so():
    response = SiteResponse(PLAY_NEWTON, 0.0, 20.0, 0.1 * PLAY_NEWTON, 0.0, 0.0)
    off, on = Bench(step_frames=2).untouched(), Bench(step_frames=2, response=response).untouched()
    assert pressed_and_let_go(off).force_newton == pytest.approx(2.0 + PLAY_NEWTON / 2, abs=2e-3)
    assert pressed_and_let_go(on).force_newton == pytest.approx(2.0, abs=2e-3)
    assert off.readings[-1].compensation.response == "off"
    assert on.readings[-1].compensation.response == "on"
    systematic = [bench.readings[-1].sites[0].systematic_newton for bench in (off, on)]
    assert systematic[1] < PLAY_NEWTON / 2 < systematic[0]


@pytest.mark.parametrize(("newton", "status"), [(0.2, "uncalibrated"), (2.0, "ok"), (7.0, "uncalibrated")])
def test_a_force_beyond_those_of_calibration_says_so(newton, status):
    last = Bench(valid_newton=(0.5, 5.0)).untouched().hold(PLATE.loaded_hz(5, newton), 40)[-1]
    assert last.sites[0].status == status
    assert last.sites[0].force_newton == pytest.approx(newton, abs=0.02)
    assert last.contacts[0].touch.status == status


def test_the_shared_error_of_sensitivity_is_in_every_force():
    plain, shared = (
        Bench(sensitivity_std=std).untouched().hold(PLATE.loaded_hz(5, 4.0), 40)[-1].sites[0] for std in (0.0, 0.05)
    )
    assert math.sqrt(shared.systematic_newton**2 - plain.systematic_newton**2) == pytest.approx(0.2, rel=0.01)


def test_a_plate_is_tared_only_while_it_is_untouched():
    bench = Bench(error=CLOCK_ERROR)
    assert "not heard" in bench.chain.tare()
    bench.hold(UNTOUCHED, 15)
    assert bench.readings[-1].status == "settling"
    assert bench.chain.tare() == ""
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


def test_nothing_of_before_a_restart_is_tared():
    bench = Bench().untouched()
    bench.chain.restart()
    assert "not heard" in bench.chain.tare()
    assert bench.chain.compensation.baseline == "unknown"
