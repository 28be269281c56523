"""Sites of a plate file with a scenario's physics: which number goes where, and that runs are reproducible."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from plates import with_tables

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate, load_plate
from simulators.physics import Physics
from simulators.site_physics import SiteFrames, SitePhysics

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
