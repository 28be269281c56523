import math

import numpy as np
import pytest

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.forces.readings import ContactTracker, Touch

POSITIONS_M = ((0.001, 0.002), (-0.003, 0.004))
COVARIANCE_M2 = np.diag([1e-6, 4e-6])
TIMEOUT = 1000
WHY = Reason(ReasonCode.WINDOW_NOT_FULL, "why")


@pytest.fixture
def contacts():
    return ContactTracker(TIMEOUT)


def force(newton, site=0, noise_newton=0.001):
    return Touch(site, POSITIONS_M[site], COVARIANCE_M2, newton, noise_newton, 0.02, "ok")


def at(x_mm, y_mm, newton=1.0):
    return Touch(0, (x_mm * 1e-3, y_mm * 1e-3), COVARIANCE_M2, newton, 0.001, 0.02, "ok")


def over(site=0):
    nan = math.nan
    return Touch(site, POSITIONS_M[site], COVARIANCE_M2, nan, nan, nan, "overload", None, 10.0)


def apply(contacts, ticks, *touches, complete=False, status="ok", reason=None):
    events = contacts.update(ticks, touches, complete=complete, status=status, reason=reason)
    return [(event.event, event.contact.id, event.contact.touch.site) for event in events]


def test_onset_and_release_have_a_hysteresis(contacts):
    events = [apply(contacts, k, force(f)) for k, f in enumerate([0.0199, 0.0201, 0.0101, 0.5, 0.0101, 0.0099, 0.0199])]
    assert events == [[], [("onset", 1, 0)], [], [], [], [("release", 1, 0)], []]
    # Windows of 2, 3, 6 and 10 gates of a rising force, whose mean in the first was 4 mN: one contact, not two.
    mn = [(29.01, 6.38), (24.12, 4.62), (9.24, 1.21), (14.03, 0.79), (22.08, 0.78)]
    events = [apply(contacts, 9, force(1e-3 * newton, 0, 1e-3 * noise)) for newton, noise in mn]
    assert events == [[], [], [], [], [("onset", 2, 0)]]


def test_a_contact_keeps_identity_onset_and_peak_and_counts_its_duration(contacts):
    for ticks, newton in [(100, 0.5), (200, 2.0), (300, 1.0)]:
        apply(contacts, ticks, force(newton, 1))
    apply(contacts, 400, status="settling")
    (contact,) = contacts.contacts
    assert (contact.id, contact.touch.site, contact.since_ticks, contact.peak_newton) == (1, 1, 100, 2.0)
    assert contact.duration_ticks == 200  # the last reading has no force
    assert contact.touch.position_m == POSITIONS_M[1]


def test_one_of_two_touches_ends_where_a_reading_reports_all(contacts):
    apply(contacts, 0, force(1.0, 0), force(1.0, 1), complete=True)
    assert apply(contacts, 1, force(1.0, 1), complete=True) == [("release", 1, 0)]
    assert [contact.id for contact in contacts.contacts] == [2]


def test_a_gap_makes_the_force_unknown_and_does_not_end_the_contact(contacts):
    apply(contacts, 0, force(1.0))
    assert apply(contacts, TIMEOUT, status="settling", reason=WHY) == []
    (contact,) = contacts.contacts
    touch = contact.touch
    assert np.isnan([touch.force_newton, touch.noise_newton, touch.systematic_newton]).all()
    assert (touch.status, touch.reason) == ("settling", WHY)
    assert apply(contacts, TIMEOUT, force(1.0)) == []
    assert (contacts.contacts[0].touch.force_newton, contacts.contacts[0].touch.reason) == (1.0, None)


def test_a_contact_unknown_for_longer_than_stated_is_released_for_that_reason(contacts):
    assert [apply(contacts, ticks, force(1.0)) for ticks in (0, 500)] == [[("onset", 1, 0)], []]
    assert apply(contacts, 500 + TIMEOUT, status="no_signal") == []
    (event,) = contacts.update(501 + TIMEOUT, (), complete=False, status="no_signal", reason=None)
    assert (event.event, event.reason.code) == ("release", ReasonCode.UNKNOWN_TOO_LONG)
    assert contacts.contacts == ()


def test_a_touch_that_is_reported_without_a_force_does_not_keep_its_contact(contacts):
    apply(contacts, 0, force(1.0))
    assert apply(contacts, TIMEOUT // 2, force(math.nan), complete=True) == []
    assert math.isnan(contacts.contacts[0].touch.force_newton)
    assert contacts.contacts[0].duration_ticks == 0
    assert apply(contacts, TIMEOUT + 1, force(math.nan), complete=True) == [("release", 1, 0)]
    assert contacts.contacts == ()


def test_a_site_that_another_one_masks_is_unknown(contacts):
    apply(contacts, 0, force(1.0, 0))
    assert apply(contacts, 1, force(2.0, 1), status="no_signal") == [("onset", 2, 1)]
    masked, heard = contacts.contacts
    assert (masked.touch.site, masked.touch.status, heard.touch.site) == (0, "no_signal", 1)
    assert (math.isnan(masked.touch.force_newton), heard.touch.force_newton) == (True, 2.0)


def test_an_overload_opens_a_contact_with_a_lower_bound_only(contacts):
    assert apply(contacts, 0, over()) == [("onset", 1, 0)]
    (contact,) = contacts.contacts
    assert math.isnan(contact.touch.force_newton)
    assert (contact.touch.status, contact.touch.at_least_newton, contact.peak_newton) == ("overload", 10.0, 10.0)
    assert apply(contacts, 1, force(9.0)) == []
    assert contacts.contacts[0].touch.at_least_newton is None
    assert (contacts.contacts[0].peak_newton, contacts.contacts[0].peak_is_bound) == (10.0, True)
    assert apply(contacts, 2, over()) == []


def test_of_two_touches_within_the_reach_the_nearer_one_is_the_contact():
    contacts = ContactTracker(TIMEOUT, reach_m=1e-3)
    apply(contacts, 0, at(0, 0), complete=True)
    assert apply(contacts, 1, at(0.9, 0), at(-0.2, 0), complete=True) == [("onset", 2, 0)]
    places_m = {contact.id: contact.touch.position_m for contact in contacts.contacts}
    assert places_m == {1: at(-0.2, 0).position_m, 2: at(0.9, 0).position_m}
