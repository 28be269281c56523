import math

from resonator_daemon.estimate.forces.overload_latch import OverloadLatch
from resonator_daemon.estimate.forces.site_identification import Match, SiteForce


def outcome(**statuses):
    """Match of sites named like s3, each "ok" or "overload"."""
    forces = [
        SiteForce(int(site[1:]), 1.0 if status == "ok" else math.nan, 0.1, 0.1, status)
        for site, status in statuses.items()
    ]
    status = "rejected" if not forces else "overload" if "overload" in statuses.values() else "ok"
    return Match(status, "", 3.0, tuple(forces))


def test_the_latch_holds_no_force_of_another_site():
    latch = OverloadLatch()  # compared by their text, in which NaN is NaN
    both = outcome(s2="ok", s3="overload")
    assert repr(latch.apply(both)) == repr(both)
    assert repr(latch.apply(outcome(s4="ok"))) == repr(outcome(s3="overload"))
    # The overloaded site is received again with another one: both are of this reading.
    fresh = outcome(s3="overload", s6="ok")
    assert repr(latch.apply(fresh)) == repr(fresh)
    assert repr(latch.apply(outcome())) == repr(outcome(s3="overload"))
    assert repr(latch.apply(outcome(s3="ok", s6="ok"))) == repr(outcome(s3="ok", s6="ok"))
    assert repr(latch.apply(outcome())) == repr(outcome())
    latch.apply(outcome(s3="overload"))
    latch.release()
    assert latch.apply(outcome(s4="ok")) == outcome(s4="ok")


def test_of_two_sites_in_overload_the_one_that_stays_so_is_held():
    latch = OverloadLatch()
    latch.apply(outcome(s3="overload", s4="overload"))
    assert repr(latch.apply(outcome(s3="ok"))) == repr(outcome(s3="overload", s4="overload"))
    latch.apply(outcome(s3="ok", s4="overload"))
    assert repr(latch.apply(outcome(s9="ok"))) == repr(outcome(s4="overload"))
