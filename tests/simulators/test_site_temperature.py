"""Warmth of sites and what it shifts, against exponentials and numbers worked out by hand."""

import numpy as np
import pytest

from resonator_daemon.arrays import Floats
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


def test_each_site_has_coefficients_of_its_own() -> None:
    own = SiteTemperature(np.array([[1e-7, 0, 0], [0, 1e-8, 0], [0, 0, 1e-9]]), 0.0, REFERENCE_KELVIN, 5.0)
    shift = own.advance(1e-3, np.array([REFERENCE_KELVIN - 2]), untouched(1, 3)).relative_shift
    assert shift[0] == pytest.approx([-2e-7, 4e-8, -8e-9], abs=1e-18)


def test_a_warm_touch_heats_its_site_alone_and_the_site_cools_again() -> None:
    dt_s, gates = 0.01, 2000
    t_s = (np.arange(gates) + 0.5) * dt_s
    temperature = sites(2)
    touch = untouched(gates, 2)
    touch[:1000, 0] = REFERENCE_KELVIN + 7
    kelvin = temperature.advance(dt_s, np.full(gates, REFERENCE_KELVIN), touch).kelvin - REFERENCE_KELVIN
    assert kelvin[:1000, 0] == pytest.approx(7 * (1 - np.exp(-t_s[:1000] / 5)), abs=1e-9)
    assert kelvin[1000:, 0] == pytest.approx(7 * (1 - np.exp(-10 / 5)) * np.exp(-(t_s[1000:] - 10) / 5), abs=1e-9)
    assert np.all(np.abs(kelvin[:, 1]) < 1e-9)


def test_a_step_of_the_surroundings_is_taken_with_exp_of_t_over_5_s() -> None:
    dt_s = 1e-3
    temperature = sites()
    temperature.advance(dt_s, np.full(10, REFERENCE_KELVIN), untouched(10))
    kelvin = temperature.advance(dt_s, np.full(20_000, REFERENCE_KELVIN + 10), untouched(20_000)).kelvin[:, 0]
    t_s = (np.arange(20_000) + 0.5) * dt_s
    assert kelvin == pytest.approx(REFERENCE_KELVIN + 10 - 10 * np.exp(-t_s / 5), abs=1e-8)


def test_the_transient_goes_with_the_rate() -> None:
    """A steady ramp of 2 K/s: -2e-7 s x 2 K/s, once the site trails it by 5 s."""
    dt_s = 0.01
    t_s = np.arange(10_000) * dt_s
    warmth = sites(a=0.0, b=0.0, c=0.0, transient_s=-2e-7).advance(dt_s, REFERENCE_KELVIN + 2 * t_s, untouched(10_000))
    assert warmth.relative_shift[-1, 0] == pytest.approx(-4e-7, rel=1e-6)
    assert warmth.kelvin[-1, 0] == pytest.approx(REFERENCE_KELVIN + 2 * (t_s[-1] - 5), abs=1e-5)


def test_the_transient_is_the_derivative_of_the_temperature() -> None:
    random = np.random.default_rng(1)
    around = REFERENCE_KELVIN + np.repeat(random.normal(size=10), 200)
    warmth = sites(a=0.0, b=0.0, c=0.0, transient_s=-2e-7).advance(1e-3, around, untouched(2000))
    rate = np.gradient(warmth.kelvin[:, 0], 1e-3)
    inside = np.arange(2000) % 200 % 199 > 0  # not beside a jump of the surroundings
    assert warmth.relative_shift[inside, 0] == pytest.approx(-2e-7 * rate[inside], rel=1e-5, abs=1e-15)
