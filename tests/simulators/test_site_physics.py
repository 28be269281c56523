"""Physics of sites: against closed forms, small steps, numerical integration and numbers worked out by hand."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from plates import with_tables
from scenarios import steady
from scipy.integrate import solve_ivp

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate, load_plate
from simulators.load_sharing import SiteLoads, site_loads
from simulators.physics import Physics
from simulators.press_response import PressResponse
from simulators.scenario import Scenario
from simulators.scenario_file import Touch
from simulators.site_physics import SiteFrames, SitePhysics
from simulators.site_temperature import SiteTemperature

PLATE = load_plate("quartz16")
SITES = 16
REFERENCE_KELVIN = 298.15
SILENT = {"ideal": True, "white_fm": 0.0}


def physics(**keys: Any) -> Physics:
    return Physics.model_validate({**SILENT, **keys})


def advance(
    sites: SitePhysics,
    gates: int,
    *,
    force_newton: Floats | float = 0.0,
    touch_id: npt.NDArray[np.int64] | int = 0,
    contact_kelvin: Floats | float = math.nan,
    kelvin: Floats | float = REFERENCE_KELVIN,
    dt_s: float = 1e-3,
) -> SiteFrames:
    shape = (gates, SITES)
    return sites.advance(
        dt_s,
        np.broadcast_to(np.float64(force_newton), shape),
        np.broadcast_to(np.float64(contact_kelvin), shape),
        np.broadcast_to(np.int64(touch_id), shape),
        np.broadcast_to(np.float64(kelvin), gates),
    )


def made(plate: Plate, of: Physics, seed: int = 1) -> SitePhysics:
    return SitePhysics(plate, of, np.random.default_rng(seed))


def test_ageing_is_logarithmic_in_days() -> None:
    sites = made(PLATE, physics(ageing=2e-7))
    before = advance(sites, 864, dt_s=100.0).relative_shift
    after = advance(sites, 2 * 864, dt_s=100.0).relative_shift
    assert before[0, 0] / 2e-7 == pytest.approx(50 / 86_400, rel=1e-3)
    assert before[-1] / 2e-7 == pytest.approx(np.full(SITES + 1, math.log(2)), rel=1e-3)
    assert after[-1] / 2e-7 == pytest.approx(np.full(SITES + 1, math.log(4)), rel=1e-3)


def test_sensitivity_scatters_from_touch_to_touch_site_and_corner() -> None:
    plate = with_tables(PLATE, calibration={"model_error": 0.02})
    for of, std in ((physics(sensitivity_scatter=0.05), 0.05), (physics(sensitivity_scatter=None), 0.02)):
        sites = made(plate, of)
        each = np.array([advance(sites, 1, touch_id=touch).sensitivity_factor[0] - 1 for touch in range(1, 301)])
        assert each.std() == pytest.approx(std, rel=0.02)
        assert abs(each.mean()) < std / 30
        assert np.corrcoef(each[:, 0].T) == pytest.approx(np.eye(4), abs=0.2)
        assert np.corrcoef(each[:, :, 0].T) == pytest.approx(np.eye(SITES), abs=0.25)
        assert np.unique(each).size == each.size


def test_a_touch_keeps_its_sensitivity_also_after_an_interruption() -> None:
    sites = made(PLATE, physics(sensitivity_scatter=0.015))
    touch = np.zeros((8, SITES), dtype=np.int64)
    touch[1:3, 4], touch[3:5, 4], touch[6:, 4] = 7, 8, 7
    touch[:, 9] = 7
    factor = advance(sites, 8, touch_id=touch).sensitivity_factor
    assert np.all(factor[[0, 5], 4] == 1)
    assert np.all(factor[1:3, 4] == factor[6:, 4])
    assert np.all(factor[1, 4] != factor[3, 4])
    assert np.all(factor[:, 9] == factor[0, 9])
    assert np.all(factor[0, 9] != factor[1, 4])
    assert np.all(factor[:, 0] == 1)


A, B, C = -5e-8, -0.5e-9, 1.08e-10


def sites(count: int = 1, *, a: float = A, b: float = B, c: float = C, transient_s: float = 0.0) -> SiteTemperature:
    return SiteTemperature(np.tile([a, b, c], (count, 1)), transient_s, REFERENCE_KELVIN, 5.0)


def untouched(gates: int, count: int = 1) -> Floats:
    return np.full((gates, count), np.nan)


@pytest.mark.parametrize(("above_kelvin", "shift"), [(10.0, -4.42e-7), (-10.0, 3.42e-7), (0.0, 0.0)])
def test_at_rest_the_shift_is_the_cubic(above_kelvin: float, shift: float) -> None:
    kelvin, relative_shift = sites(2).advance(1e-3, np.full(3, REFERENCE_KELVIN + above_kelvin), untouched(3, 2))
    assert kelvin == pytest.approx(np.full((3, 2), REFERENCE_KELVIN + above_kelvin), abs=1e-10)
    assert relative_shift == pytest.approx(np.full((3, 2), shift), abs=1e-17)


def test_the_transient_is_the_derivative_of_the_temperature() -> None:
    random = np.random.default_rng(1)
    around = REFERENCE_KELVIN + np.repeat(random.normal(size=10), 200)
    warmth = sites(a=0.0, b=0.0, c=0.0, transient_s=-2e-7).advance(1e-3, around, untouched(2000))
    rate = np.gradient(warmth.kelvin[:, 0], 1e-3)
    inside = np.arange(2000) % 200 % 199 > 0  # away from jumps of the surroundings
    assert warmth.relative_shift[inside, 0] == pytest.approx(-2e-7 * rate[inside], rel=1e-5, abs=1e-15)


def forces(gates: int, sites: int, seed: int) -> Floats:
    """Presses with reversals of all sizes, from far below the play to far above it."""
    random = np.random.default_rng(seed)
    return np.abs(np.cumsum(random.choice([-1, 1], (gates, sites)) * 0.2 * random.random((gates, sites)) ** 3, axis=0))


def test_the_play_is_the_force_less_a_stop_that_gives_way() -> None:
    force = forces(400, 3, seed=1)
    felt = PressResponse(3, 0.1, 0.0, 20.0).advance(1e-3, force)
    for site in range(3):
        stop, last = 0.0, 0.0
        for gate, now in enumerate(force[:, site]):
            for _ in range(50):  # small steps
                stop += (now - last) / 50
                stop = 0.1 if stop > 0.1 else -0.1 if stop < -0.1 else stop
            last = now
            assert felt[gate, site] == pytest.approx(now - stop / 2, abs=1e-12)


def test_creep_under_any_force_is_the_integral_of_its_differential_equation() -> None:
    pressed = forces(60, 1, seed=2)
    felt, force = PressResponse(1, 0.0, 0.3, 2.0).advance(0.1, pressed)[:, 0], pressed[:, 0]
    crept = solve_ivp(
        lambda t, u: (force[min(int(t / 0.1), 59)] - u) / 2.0,
        (0, 6),
        [0.0],
        t_eval=(np.arange(60) + 0.5) * 0.1,
        max_step=1e-3,
        rtol=1e-8,
    ).y[0]
    assert felt == pytest.approx(0.7 * force + 0.3 * crept, abs=2e-4)


QUARTZ, COMB = load_plate("quartz16"), load_plate("comb16")
PLACES = {int(site): index for index, site in enumerate(QUARTZ.site_ids)}
NEAR, FAR = (QUARTZ.site_positions_m[PLACES[site]] for site in (7, 9))


def loads(*touches: Touch, times_s: npt.ArrayLike = (5.0,), plate: object = QUARTZ) -> SiteLoads:
    scenario = Scenario(touches, None, plate)
    return site_loads(scenario.at(np.array(times_s)), plate)


def test_a_touch_between_sites_is_shared_by_distance_to_the_power_of_minus_4() -> None:
    force = loads(steady(3.0, position_mm=tuple((2 * NEAR + FAR) / 3 * 1e3))).force_newton[0]
    assert force.sum() == pytest.approx(3.0)
    assert force[PLACES[7]] / force[PLACES[9]] == pytest.approx(2.0**4)
    assert force[PLACES[7]] == force.max()


def test_a_finger_warms_the_sites_that_bear_most_of_it() -> None:
    middle = tuple((NEAR + FAR) / 2 * 1e3)
    result = loads(steady(2.0, start_s=1.0, position_mm=middle, kelvin=306.0), steady(1.0, site=4), times_s=(0.5, 5.0))
    assert np.isnan(result.contact_kelvin[0]).all()
    warmed = np.flatnonzero(~np.isnan(result.contact_kelvin[1])).tolist()
    assert warmed == sorted((PLACES[7], PLACES[9]))
    assert np.nanmin(result.contact_kelvin[1]) == 306.0
    assert result.touch_id[0, PLACES[7]] == 0
    assert result.touch_id[1, [PLACES[7], PLACES[4]]].tolist() == [1, 2]
