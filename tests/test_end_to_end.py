"""Forces, sites and uncertainties from end to end: emulated plates counted straight into the daemon's chain.

Truth is the emulator's, which shares no formula with the chain.
"""

import pytest
from end_to_end_held import contacts_of_a_shock, hold, sites_of_a_whole_press
from end_to_end_pairs import play_pairs
from end_to_end_touches import (
    creeping_touches,
    described_plate,
    hysteretic_touches,
    ideal_touches,
    short_touches,
    warm_touches,
)
from plates import with_counter

from resonator_daemon.base.plate import load_plate
from simulators.physics import Physics

TOUCHES = 5
SHORT_TOUCHES = 50
PAIRS = 16
COMB_PAIRS = 8
HELD_S = 30.0


def test_ideal_sites_are_all_found_and_their_forces_right_to_3_millinewtons() -> None:
    played = ideal_touches(TOUCHES)
    assert (played.found, played.wrong, played.more) == (TOUCHES, 0, 0)
    assert played.errors.rms_newton <= 3e-3


def test_creep_is_taken_out_where_the_plate_file_determines_it() -> None:
    configured = creeping_touches(TOUCHES, configured=True)
    assert configured.errors.rms_newton <= 10e-3
    assert creeping_touches(TOUCHES, configured=False).errors.rms_newton > 3.0 * configured.errors.rms_newton


def test_hysteresis_is_taken_out_where_the_plate_file_determines_it() -> None:
    configured = hysteretic_touches(TOUCHES, configured=True)
    assert configured.errors.rms_newton <= 35e-3
    assert hysteretic_touches(TOUCHES, configured=False).errors.rms_newton > 3.0 * configured.errors.rms_newton


def test_what_a_warm_finger_does_stays_within_what_is_stated_of_it() -> None:
    played = warm_touches((0.5, 5.0, 20.0), 50.0)
    assert (played.found, played.wrong) == (played.touches, 0)
    assert played.errors.worst_ratio <= 1.0


def test_stated_uncertainty_covers_the_errors_of_short_touches_and_is_not_much_larger() -> None:
    played = short_touches(SHORT_TOUCHES)
    assert (played.found, played.wrong) == (SHORT_TOUCHES, 0)
    for errors in (played.errors, played.errors.of_touches):
        assert errors.covered >= 0.93
        assert errors.stated_newton <= 2.0 * errors.rms_newton
    assert played.more <= 0.01 * SHORT_TOUCHES


def test_two_touches_on_captured_tones_are_found_and_never_put_elsewhere() -> None:
    pairs = play_pairs(described_plate("quartz16"), PAIRS)
    separable = [pair for pair in pairs if pair.separable]
    assert sum(pair.wrong for pair in pairs) == 0
    assert sum(pair.both > 0 for pair in separable) >= 0.9 * len(separable)  # 0.95, less a deviation of so few
    assert all(pair.both or pair.more for pair in separable)
    assert sum(pair.more for pair in pairs) >= 0.9 * sum(pair.joint for pair in pairs)


def test_two_touches_on_channelised_tones_are_both_found() -> None:
    pairs = play_pairs(described_plate("comb16"), COMB_PAIRS)
    assert sum(pair.wrong for pair in pairs) == 0
    assert sum(pair.both > 0 for pair in pairs) >= COMB_PAIRS - 1  # 0.99 of them, less one deviation
    assert max(apart_m for pair in pairs for apart_m in pair.apart_m) < 5e-3


def test_a_press_held_while_the_room_warms_does_not_drift_where_all_tones_are_received() -> None:
    plate = with_counter(load_plate("comb16"), frame_rate_hz=12.5)
    site, _ = hold(plate, Physics(ideal=True, temperature_coefficient=-5e-8), 7, HELD_S)
    assert site.known == 1.0
    assert abs(site.end_newton) <= 1e-3


@pytest.mark.parametrize(("name", "frame_rate_hz"), [("comb16", 12.5), ("quartz16", 50.0)])
def test_a_press_held_on_a_plate_with_every_imperfection_stays_within_what_is_stated(
    name: str, frame_rate_hz: float
) -> None:
    for held in hold(with_counter(described_plate(name), frame_rate_hz=frame_rate_hz), Physics(), 7, HELD_S):
        assert (held.known, held.covered) == (1.0, 1.0)


def test_a_thermal_shock_is_no_contact() -> None:
    assert contacts_of_a_shock(with_counter(described_plate("comb16"), frame_rate_hz=50.0)) == 0


def test_a_press_of_the_whole_plate_is_felt_on_every_site() -> None:
    assert sites_of_a_whole_press(described_plate("comb16"), hold_s=0.1) == 16
