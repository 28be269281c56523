import math

import numpy as np
import pytest

from resonator_daemon.measurement.contacts import ContactTracker
from resonator_daemon.measurement.matching import SiteForce

POSITIONS_M = np.array([[0.001, 0.002], [-0.003, 0.004]])
STD_M = np.array([[1e-3, 2e-3], [3e-3, 4e-3]])
TIMEOUT = 1000


def tracker():
    return ContactTracker(POSITIONS_M, STD_M, TIMEOUT)


def force(newton, site=0):
    return SiteForce(site, newton, 0.001, 0.02, "ok")


def over(site=0):
    return SiteForce(site, math.nan, math.nan, math.nan, "overload", 10.0)


def tell(contacts, ticks, *forces, untouched=False, status="ok", reason=""):
    events = contacts.update(ticks, forces, untouched=untouched, status=status, reason=reason)
    return [(event.event, event.contact.id, event.contact.site) for event in events]


def test_onset_and_release_have_a_hysteresis():
    contacts = tracker()
    told = [tell(contacts, k, force(f)) for k, f in enumerate([0.0199, 0.0201, 0.0101, 0.5, 0.0101, 0.0099, 0.0199])]
    assert told == [[], [("onset", 1, 0)], [], [], [], [("release", 1, 0)], []]
    assert contacts.contacts == ()


def test_a_contact_keeps_identity_onset_and_peak():
    contacts = tracker()
    for ticks, newton in [(100, 0.5), (200, 2.0), (300, 1.0)]:
        tell(contacts, ticks, force(newton, 1))
    (contact,) = contacts.contacts
    assert (contact.id, contact.site, contact.since_ticks, contact.peak_newton) == (1, 1, 100, 2.0)
    assert (contact.force_newton, contact.noise_newton, contact.systematic_newton) == (1.0, 0.001, 0.02)
    assert (contact.position_m, contact.position_std_m) == ((-0.003, 0.004), (3e-3, 4e-3))
    assert contact.status == "ok"


def test_the_next_touch_is_another_contact():
    contacts = tracker()
    assert tell(contacts, 0, force(1.0)) == [("onset", 1, 0)]
    assert tell(contacts, 1, untouched=True) == [("release", 1, 0)]
    assert tell(contacts, 2, force(1.0)) == [("onset", 2, 0)]


def test_release_says_when_and_why():
    contacts = tracker()
    tell(contacts, 5, force(1.5))
    (event,) = contacts.update(77, (), untouched=True, status="ok", reason="")
    assert (event.event, event.board_ticks, event.reason) == ("release", 77, "the pilot is heard")
    assert (event.contact.peak_newton, event.contact.since_ticks) == (1.5, 5)


def test_a_gap_makes_the_force_unknown_and_does_not_end_the_contact():
    contacts = tracker()
    tell(contacts, 0, force(1.0))
    assert tell(contacts, TIMEOUT, status="settling", reason="why") == []
    (contact,) = contacts.contacts
    assert math.isnan(contact.force_newton)
    assert math.isnan(contact.noise_newton)
    assert math.isnan(contact.systematic_newton)
    assert (contact.status, contact.reason) == ("settling", "why")
    assert tell(contacts, TIMEOUT + 1, force(1.0)) == []
    assert contacts.contacts[0].force_newton == 1.0
    assert contacts.contacts[0].reason == ""


def test_a_contact_unknown_for_longer_than_stated_is_released_for_that_reason():
    contacts = tracker()
    tell(contacts, 0, force(1.0))
    tell(contacts, 500, force(1.0))
    assert tell(contacts, 500 + TIMEOUT, status="no_signal") == []
    (event,) = contacts.update(501 + TIMEOUT, (), untouched=False, status="no_signal", reason="")
    assert event.event == "release"
    assert "unknown" in event.reason
    assert contacts.contacts == ()


def test_a_site_that_another_one_masks_is_unknown():
    contacts = tracker()
    tell(contacts, 0, force(1.0, 0))
    assert tell(contacts, 1, force(2.0, 1), status="no_signal") == [("onset", 2, 1)]
    masked, heard = contacts.contacts
    assert (masked.site, masked.status) == (0, "no_signal")
    assert math.isnan(masked.force_newton)
    assert (heard.site, heard.force_newton) == (1, 2.0)


def test_an_overload_opens_a_contact_with_a_lower_bound_only():
    contacts = tracker()
    assert tell(contacts, 0, over()) == [("onset", 1, 0)]
    (contact,) = contacts.contacts
    assert contact.status == "overload"
    assert math.isnan(contact.force_newton)
    assert (contact.at_least_newton, contact.peak_newton) == (10.0, 10.0)
    assert tell(contacts, 1, force(9.0)) == []
    assert contacts.contacts[0].at_least_newton is None
    assert contacts.contacts[0].peak_newton == 10.0
    assert tell(contacts, 2, over()) == []


def test_closing_releases_every_contact_with_the_reason_given():
    contacts = tracker()
    tell(contacts, 0, force(1.0, 0), force(1.0, 1))
    events = contacts.close(9, "because")
    assert [(event.contact.site, event.board_ticks, event.reason) for event in events] == [
        (0, 9, "because"),
        (1, 9, "because"),
    ]
    assert contacts.contacts == ()


@pytest.mark.parametrize("positions", [np.zeros(2), np.zeros((2, 3)), np.zeros((3, 2))])
def test_positions_of_a_wrong_shape_are_refused(positions):
    with pytest.raises(ValueError, match=r"\(m, 2\)"):
        ContactTracker(positions, np.zeros((2, 2)), TIMEOUT)
