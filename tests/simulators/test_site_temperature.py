"""Warmth of sites and what it shifts, against exponentials and numbers worked out by hand."""

import numpy as np
import pytest

from resonator_daemon.base.arrays import Floats
from simulators.site_temperature import SiteTemperature

REFERENCE_KELVIN = 298.15
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
    inside = np.arange(2000) % 200 % 199 > 0  # not beside a jump of the surroundings
    assert warmth.relative_shift[inside, 0] == pytest.approx(-2e-7 * rate[inside], rel=1e-5, abs=1e-15)
