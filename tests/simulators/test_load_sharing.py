"""Loads of sites under touches: shares by hand, sums over touches, warmth and numbers."""

import numpy as np
import numpy.typing as npt
import pytest
from scenarios import steady

from resonator_daemon.base.plate import load_plate
from simulators.load_sharing import SiteLoads, site_loads
from simulators.scenario import Scenario
from simulators.scenario_file import Touch

QUARTZ, COMB = load_plate("quartz16"), load_plate("comb16")
SITES = {int(site): index for index, site in enumerate(QUARTZ.site_ids)}
NEAR, FAR = (QUARTZ.site_positions_m[SITES[site]] for site in (7, 9))


def loads(*touches: Touch, times_s: npt.ArrayLike = (5.0,), plate: object = QUARTZ) -> SiteLoads:
    scenario = Scenario(touches, None, plate)
    return site_loads(scenario.at(np.array(times_s)), plate)


def test_a_touch_between_sites_is_shared_by_distance_to_the_power_of_minus_4() -> None:
    force = loads(steady(3.0, position_mm=tuple((2 * NEAR + FAR) / 3 * 1e3))).force_newton[0]
    assert force.sum() == pytest.approx(3.0)
    assert force[SITES[7]] / force[SITES[9]] == pytest.approx(2.0**4)
    assert force[SITES[7]] == force.max()


def test_a_finger_warms_the_sites_that_bear_most_of_it() -> None:
    middle = tuple((NEAR + FAR) / 2 * 1e3)
    result = loads(steady(2.0, start_s=1.0, position_mm=middle, kelvin=306.0), steady(1.0, site=4), times_s=(0.5, 5.0))
    assert np.isnan(result.contact_kelvin[0]).all()
    warmed = np.flatnonzero(~np.isnan(result.contact_kelvin[1])).tolist()
    assert warmed == sorted((SITES[7], SITES[9]))
    assert np.nanmin(result.contact_kelvin[1]) == 306.0
    assert result.touch_id[0, SITES[7]] == 0
    assert result.touch_id[1, [SITES[7], SITES[4]]].tolist() == [1, 2]
