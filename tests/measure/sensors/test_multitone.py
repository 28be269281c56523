import math

import numpy as np
import pytest
from small_comb import GATE_S, GATE_TICKS, POSITION_M, SITES, SmallComb, spread

from resonator_daemon.base.reasons import Reason, ReasonCode

PLACE_M = (1.2e-3, -0.9e-3)  # between sites
FAR_M = (-6.5e-3, 5.8e-3)
# On sites 5 mm apart: every touch that loads one by 2 N under a cover of 2.5 mm loads its neighbours by more than this.
UNLIKE_TOUCHES_NEWTON = np.where(np.indices((4, 4)).sum(axis=0).ravel() % 2, 2.0, 0.05)


def events(readings):
    return [event.event for reading in readings for event in reading.events]


def distance_m(contact, place_m):
    return math.dist(contact.touch.position_m, place_m)


@pytest.fixture
def comb() -> SmallComb:
    return SmallComb().untouched()


def test_a_touch_between_sites_is_one_contact_with_its_place_and_force(comb: SmallComb):
    pressed = comb.hold(spread(2.0, *PLACE_M), 40)
    assert events(pressed) == ["onset"]
    assert pressed[-1].status == "ok"
    nearest = int(np.hypot(*(POSITION_M - PLACE_M).T).argmin())
    errors = []
    for reading in pressed[2:]:
        (contact,) = reading.contacts
        touch = contact.touch
        assert (touch.site, touch.status) == (nearest, "ok")
        error = np.array([*np.subtract(touch.position_m, PLACE_M), touch.force_newton - 2.0])
        std = [*np.sqrt(np.diag(touch.position_covariance_m2)), math.hypot(touch.noise_newton, touch.systematic_newton)]
        errors.append(error / std)
        assert np.abs(error[:2]).max() < 20e-6
        assert abs(error[2]) < 0.01
    assert np.abs(errors).max() < 4
    released = comb.hold(frames=40)
    assert events(released) == ["release"]
    assert released[-1].contacts == ()


def test_an_onset_is_told_within_two_gates(comb: SmallComb):
    told = [event for reading in comb.hold(spread(0.5, *PLACE_M), 10) for event in reading.events]
    assert told[0].board_ticks - (comb.board_ticks - 10 * GATE_TICKS) <= 2 * GATE_TICKS


@pytest.mark.parametrize("second_newton", [2.0, 0.3])
def test_two_touches_are_two_contacts(comb: SmallComb, second_newton):
    both = spread(1.5, *PLACE_M) + spread(second_newton, *FAR_M)
    last = comb.hold(both, 40)[-1]
    assert (last.status, len(last.contacts)) == ("ok", 2)
    first, second = sorted(last.contacts, key=lambda contact: distance_m(contact, PLACE_M))
    assert distance_m(first, PLACE_M) < 30e-6
    assert distance_m(second, FAR_M) < 100e-6
    assert first.touch.force_newton == pytest.approx(1.5, abs=0.02)
    assert second.touch.force_newton == pytest.approx(second_newton, abs=0.02)
    one = comb.hold(spread(1.5, *PLACE_M), 40)
    assert [event.contact.id for reading in one for event in reading.events] == [second.id]
    assert one[-1].contacts[0].id == first.id


def test_a_press_of_the_whole_plate_is_felt_by_every_site_and_no_touch_is_made_up(comb: SmallComb):
    load = UNLIKE_TOUCHES_NEWTON
    pressed = comb.hold(load, 20)
    last = pressed[-1]
    assert (last.status, last.contacts, events(pressed)) == ("rejected", (), [])
    assert last.reason.code is ReasonCode.NO_TOUCHES_FIT
    assert [force.site for force in last.sites] == list(range(SITES))
    for force in last.sites:
        assert abs(force.force_newton - load[force.site]) < 3 * math.hypot(force.noise_newton, force.systematic_newton)
        assert force.force_newton == pytest.approx(load[force.site], abs=0.05)
    assert last.compensation.baseline == "held"
    released = comb.hold(frames=30)[-1]
    assert (released.status, released.sites) == ("ok", ())


def test_a_plate_without_a_cover_has_a_contact_for_each_site():
    load = np.random.default_rng(5).uniform(0.5, 2.0, SITES)
    comb = SmallComb(width_m=None).untouched()
    last = comb.hold(load, 60)[-1]
    assert last.status == "ok"
    assert [contact.touch.site for contact in last.contacts] == list(range(SITES))
    for contact in last.contacts:
        assert contact.touch.force_newton == pytest.approx(load[contact.touch.site], abs=0.05)
        assert contact.touch.position_m == pytest.approx(tuple(POSITION_M[contact.touch.site]))
    released = comb.hold(frames=60)
    assert events(released) == ["release"] * SITES


def test_contacts_of_before_have_no_force_while_no_touch_can_be_named(comb: SmallComb):
    (before,) = comb.hold(spread(1.0, *PLACE_M), 40)[-1].contacts
    load = UNLIKE_TOUCHES_NEWTON
    (meanwhile,) = comb.hold(load, 20)[-1].contacts
    assert meanwhile.id == before.id
    assert meanwhile.touch.status == "rejected"
    assert math.isnan(meanwhile.touch.force_newton)
    ended = comb.hold(load, 105)
    assert events(ended) == ["release"]
    assert ended[-1].contacts == ()


def test_a_touch_beside_what_is_no_touch_is_named_as_possibly_more(comb: SmallComb):
    load = spread(3.0, *PLACE_M)
    load[0] += 0.4  # something sharp on one far site: its neighbours feel nothing of it
    last = comb.hold(load, 40)[-1]
    assert last.status == "possibly_more"
    assert last.reason.code is ReasonCode.NO_TOUCHES_FIT
    (contact,) = last.contacts
    assert contact.touch.status == "possibly_more"
    assert distance_m(contact, PLACE_M) < 0.1e-3
    assert contact.touch.force_newton == pytest.approx(3.0, rel=0.03)
    assert comb.chain.tare() == "sites are touched"


@pytest.mark.parametrize("newton", [0.3, 3.0])
def test_an_even_press_of_the_whole_plate_names_no_contact(comb: SmallComb, newton):
    # Four touches in the middle of four sites each would explain most of it.
    pressed = comb.hold(np.full(SITES, newton), 20)
    assert (pressed[-1].status, pressed[-1].contacts, events(pressed)) == ("rejected", (), [])
    assert [round(force.force_newton, 1) for force in pressed[-1].sites] == [newton] * SITES
    released = comb.hold(frames=40)[-1]
    assert (released.status, released.sites) == ("ok", ())


@pytest.mark.parametrize("offset", [1e-7, -5e-8])
def test_a_site_that_is_off_by_less_than_a_contact_leaves_the_others_to_tell(comb: SmallComb, offset):
    off = np.where(np.arange(SITES) == 5, offset, 0.0)
    readings = comb.hold(offset=off, frames=200)
    assert {reading.status for reading in readings} == {"ok"}
    assert all(reading.contacts == () for reading in readings)
    assert readings[-1].compensation.baseline == "followed"
    assert comb.chain.tare() is None
    (contact,) = comb.hold(spread(2.0, *FAR_M), 20, offset=off)[-1].contacts
    assert distance_m(contact, FAR_M) < 0.1e-3
    assert contact.touch.force_newton == pytest.approx(2.0, abs=0.02)


def test_a_restart_releases_contacts_and_learns_anew(comb: SmallComb):
    comb.hold(spread(1.0, *PLACE_M), 20)
    (event,) = comb.chain.restart()
    assert (event.event, event.reason.code) == ("release", ReasonCode.BOARD_RESTARTED)
    assert comb.chain.compensation.baseline == "unknown"
    assert comb.chain.tare() == "no reading yet"
    assert comb.hold(frames=100)[-1].contacts == ()
    assert comb.hold(spread(1.0, *PLACE_M), 20)[-1].contacts[0].touch.force_newton == pytest.approx(1.0, abs=0.01)


def test_missing_frames_restart_the_window_and_keep_the_contact():
    comb = SmallComb(window_frames=4).untouched()
    load = spread(1.0, *PLACE_M)
    (before,) = comb.hold(load, 20)[-1].contacts
    comb.lose(20)
    after = comb.hold(load, 6)
    assert [round(reading.window_s / GATE_S) for reading in after] == [1, 2, 3, 4, 4, 4]
    assert events(after) == []
    assert after[-1].contacts[0].id == before.id
    comb.lose(200)
    assert events(comb.hold(load, 6)) == ["release", "onset"]


def test_a_tone_that_is_not_heard_leaves_the_others_to_tell(comb: SmallComb):
    comb.known[:, int(spread(1.0, *PLACE_M).argmax())] = False
    last = comb.hold(spread(2.0, *PLACE_M), 40)[-1]
    assert (last.status, last.reason) == ("ok", Reason(ReasonCode.SITES_SILENT, "1 of 16 sites are not detected"))
    (contact,) = last.contacts
    assert distance_m(contact, PLACE_M) < 0.2e-3
    assert contact.touch.force_newton == pytest.approx(2.0, rel=0.05)
    comb.known[:] = True
    comb.known[:3] = False  # one corner hears all sites
    last = comb.hold(spread(2.0, *PLACE_M), 40)[-1]
    assert (last.status, last.reason) == ("ok", None)


def test_where_nothing_is_heard_nothing_is_told(comb: SmallComb):
    comb.hold(spread(2.0, *PLACE_M), 40)
    comb.known[:] = False
    silent = comb.hold(spread(2.0, *PLACE_M), 40)
    assert {(reading.status, reading.reason.code) for reading in silent[2:]} == {("no_signal", ReasonCode.NO_TONE)}
    (contact,) = silent[-1].contacts
    assert (contact.touch.status, math.isnan(contact.touch.force_newton)) == ("no_signal", True)
    assert events(comb.hold(frames=100)) == ["release"]
    comb.known[:] = True
    assert comb.hold(frames=40)[-1].status == "ok"


def test_a_force_beyond_the_range_has_a_bound_and_no_number(comb: SmallComb):
    (contact,) = comb.hold(spread(12.0, *PLACE_M), 40)[-1].contacts
    touch = contact.touch
    assert (touch.status, touch.at_least_newton) == ("overload", 10.0)
    assert math.isnan(touch.force_newton)
    assert distance_m(contact, PLACE_M) < 0.1e-3
