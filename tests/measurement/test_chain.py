import math

import numpy as np
import pytest
from brute_force_board import GATE_TICKS, PILOT_HZ, REFERENCE_HZ, Board, Ladder
from small_skin import SITES, TONES, YOUNGS_MODULUS_PASCAL, Comb, dimensionless, some_signals

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.chain import ChannelisedChain, SingleToneChain

PLATE = Ladder()
UNTOUCHED = np.full(4, PILOT_HZ)
CLOCK_ERROR = 3e-5


class Bench:
    """A chain fed by a board, with the readings it gave."""

    def __init__(self, plate=PLATE, *, window_frames=10, step_frames=5, seed=0, exponent=None, error=0.0):
        self.board = Board(seed)
        self.error = error
        self.readings = []
        self.chain = SingleToneChain(
            plate.f0_hz,
            plate.sensitivity,
            plate.positions_m,
            plate.outline_m,
            force_max_newton=plate.force_max_newton,
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
    return [(event.event, event.contact.site) for reading in readings for event in reading.events]


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
        assert contact.force_newton == last.sites[0].force_newton
        assert contact.position_m == pytest.approx(tuple(plate.positions_m[site]))
        released = bench.hold(UNTOUCHED, 40)
        assert events(released) == [("release", site)]
        assert released[-1].contacts == ()
    assert last.common_mode == pytest.approx([error] * 4, abs=3e-8)


def test_the_onset_is_told_within_one_window_and_one_step_of_the_capture():
    bench = Bench().untouched()
    told = [reading for reading in bench.hold(PLATE.loaded_hz(3, 1.0), 20) if reading.events]
    assert told[0].board_ticks - (bench.board.board_ticks - 20 * GATE_TICKS) <= 15 * GATE_TICKS


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
    assert all(math.isnan(g) for g in pressed[-1].common_mode)
    released = bench.hold(UNTOUCHED, 200)
    assert released[-1].status == "ok"
    assert bench.hold(PLATE.loaded_hz(3, 2.0), 40)[-1].sites[0].force_newton == pytest.approx(2.0, abs=0.02)


def test_a_reboot_while_pressed_gives_no_force_until_the_pilot_is_heard():
    bench = Bench().untouched()
    assert bench.hold(PLATE.loaded_hz(3, 2.0), 40)[-1].sites
    ended = bench.chain.restart()
    assert [(event.event, event.contact.site) for event in ended] == [("release", 3)]
    pressed = bench.hold(PLATE.loaded_hz(3, 2.0), 300)
    assert pressed[-1].status == "pressed_at_start"
    assert all(reading.sites == () and reading.contacts == () for reading in pressed)


def test_a_restart_before_the_first_frame_has_nothing_to_release():
    assert Bench().chain.restart() == ()


def test_a_held_press_is_never_tared_away():
    bench = Bench().untouched()
    pressed = bench.hold(PLATE.loaded_hz(5, 1.0), 3000)
    assert pressed[-1].sites[0].force_newton == pytest.approx(1.0, abs=0.01)
    assert pressed[-1].common_mode == pressed[0].common_mode


def test_a_gap_restarts_the_windows_and_keeps_the_contact():
    bench = Bench().untouched()
    site_hz = PLATE.loaded_hz(6, 1.5)
    before = bench.hold(site_hz, 40)[-1].contacts[0]
    bench.lose(site_hz, 101)
    after = bench.hold(site_hz, 40)
    assert after[0].status == "settling"
    assert after[0].sites == ()
    assert math.isnan(after[0].contacts[0].force_newton)
    assert after[0].contacts[0].status == "settling"
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
    assert reading.status == "settling"


def test_corners_that_still_hear_the_pilot_are_left_out():
    bench = Bench().untouched()
    light = np.where([True, False, True, False], PLATE.loaded_hz(2, 0.05), UNTOUCHED)
    last = bench.hold(light, 40)[-1]
    assert last.status == "ok"
    assert [force.site for force in last.sites] == [2]
    assert last.sites[0].force_newton == pytest.approx(0.05, abs=0.01)


def test_two_touches_that_split_the_corners_give_no_force():
    bench = Bench().untouched()
    split = np.where([True, True, False, False], PLATE.loaded_hz(2, 1.0), PLATE.loaded_hz(9, 2.0))
    last = bench.hold(split, 40)[-1]
    assert last.status == "ambiguous"
    assert last.sites == ()


def test_load_sharing_widens_the_systematic_only():
    plain = Bench().untouched().hold(PLATE.loaded_hz(2, 1.0), 40)[-1].sites[0]
    shared = Bench(exponent=4.0).untouched().hold(PLATE.loaded_hz(2, 1.0), 40)[-1].sites[0]
    assert shared.force_newton == plain.force_newton
    assert shared.noise_newton == plain.noise_newton
    assert shared.systematic_newton > 0.5 > plain.systematic_newton


NO_SIGNAL = int(RecordFlag.NO_SIGNAL)


def test_a_channel_without_signal_is_left_out_and_counted():
    bench = Bench().untouched()
    before = bench.chain.unusable.copy()
    last = bench.hold(PLATE.loaded_hz(2, 1.0), 40, (0, NO_SIGNAL, 0, 0))[-1]
    assert last.status == "ok"
    assert last.sites[0].force_newton == pytest.approx(1.0, abs=0.02)
    assert math.isnan(last.frequency_hz[1])
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


def test_a_corner_that_is_dead_from_the_start_is_named_and_gives_no_force():
    bench = Bench()
    last = bench.hold(UNTOUCHED, 300, (0, 0, NO_SIGNAL, 0))[-1]
    assert last.status == "pilot_lost"
    assert last.reason == "channel 2: no_signal"
    assert bench.hold(PLATE.loaded_hz(2, 1.0), 40)[-1].status == "pressed_at_start"


def test_the_first_readings_settle():
    readings = Bench().hold(UNTOUCHED, 30)
    assert {reading.status for reading in readings} == {"settling"}
    assert "window not full" in readings[0].reason
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


KNOWN = np.ones((4, TONES), dtype=bool)
SIGMA_CODE = np.full((4, TONES), 128 - 40, dtype=np.uint8)  # 2^-5 Hz


class Skin:
    """A channelised chain fed with frames of whole 2^-16 Hz."""

    def __init__(self, seed=0):
        self.comb, self.rng, self.sequence = Comb(), np.random.default_rng(seed), 0
        comb = self.comb
        self.chain = ChannelisedChain(
            comb.f0_hz,
            comb.sensitivity,
            comb.oscillator_hz,
            comb.site_index,
            comb.signal_index,
            youngs_modulus_pascal=YOUNGS_MODULUS_PASCAL,
            gate_s=0.004,
        )

    def push(self, physical, common_mode=2e-5, known=KNOWN):
        self.sequence += 1
        offset = self.comb.offset_hz(physical, common_mode) + 2.0**-5 * self.rng.normal(size=(4, TONES))
        offset_hz16 = np.round(offset * 65_536).astype(np.int32)
        return self.chain.push(self.sequence, 1000 * self.sequence, offset_hz16, SIGMA_CODE, known)


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


def test_a_skins_restart_forgets_the_common_mode():
    skin = Skin()
    for _ in range(20):
        skin.push(NOTHING)
    skin.chain.restart()
    assert skin.push(some_signals()).status == "pressed_at_start"


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
    assert "5 tones" in fresh.reason


def test_a_frame_of_a_wrong_shape_is_refused():
    skin = Skin()
    with pytest.raises(ValueError, match="must be"):
        skin.chain.push(0, 0, np.zeros((4, 5), dtype=np.int32), SIGMA_CODE, KNOWN)
