import math

import numpy as np
import pytest
from brute_force_board import Ladder
from drawn_touches import NOISE, matcher_of

from resonator_daemon.forces.overload_latch import OverloadLatch
from resonator_daemon.forces.site_identification import Match, SiteForce


@pytest.mark.parametrize("pull", [0.0, 25e-6])
def test_no_force_of_a_ramp_to_80_newton_looks_plausible_while_latched(pull):
    plate = Ladder(pull=pull)
    matcher = matcher_of(plate)
    for site in range(0, 16, 3):
        latch = OverloadLatch()
        unlatched_plausible = 0
        for force in np.concatenate([np.arange(0.5, 9.0, 0.5), np.arange(9.05, 11.0, 0.1), np.arange(11.0, 80.0, 0.5)]):
            raw = matcher.match(plate.loaded_hz(site, force), *NOISE)
            match = latch.apply(raw)
            if force <= 9.95:
                assert match.status == "ok"
                assert match.forces[0].force_newton == pytest.approx(force, abs=1e-3)
            elif force >= 10.05:
                unlatched_plausible += raw.status == "ok"
                assert match.status == "overload"
                assert match.forces[0].site == site
                assert math.isnan(match.forces[0].force_newton)
        # Without a latch the ramp crosses the codes of the sites below, where there are any.
        if pull == 0 and plate.code[site] < 16 and abs(plate.sensitivity[site, 0]) > 5.2e-6:
            assert unlatched_plausible > 0


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
    # The overloaded site is heard again beside another one: both are of this reading.
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
