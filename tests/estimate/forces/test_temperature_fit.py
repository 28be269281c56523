import numpy as np
import pytest

from resonator_daemon.estimate.forces.temperature_fit import fit_temperature

REFERENCE_KELVIN = 298.15
DEFAULT = np.array([-5e-8, -5e-10, 1.08e-10])
DEFAULT_STD = np.array([5e-8, 5e-10, 2e-11])
TRUE = np.array([[-9e-8, -9e-10, 1.2e-10], [2e-8, 2e-10, 0.9e-10], [-5e-8, -5e-10, 1.08e-10]])


def sweep(span_kelvin, *, noise=2e-9, seed=0, count=60):
    """Shifts of three sites, each with its own constant, by the polynomial written out."""
    rng = np.random.default_rng(seed)
    kelvin = np.linspace(REFERENCE_KELVIN - span_kelvin / 2, REFERENCE_KELVIN + span_kelvin / 2, count)
    d = kelvin - REFERENCE_KELVIN
    shift = np.stack([a * d + b * d * d + c * d * d * d for a, b, c in TRUE], axis=1)
    return kelvin, shift + np.array([3e-6, -1e-5, 0.0]) + noise * rng.normal(size=shift.shape)


def fit(kelvin, shift, noise=2e-9):
    return fit_temperature(kelvin, shift, np.full(3, noise), DEFAULT, DEFAULT_STD, REFERENCE_KELVIN)


def test_a_wide_sweep_tells_all_three_terms():
    result = fit(*sweep(40.0))
    assert (np.abs(result.coefficient - TRUE) < 3.5 * result.coefficient_std).all()
    assert result.coefficient[:, 0] == pytest.approx(TRUE[:, 0], abs=2e-10)
    assert result.coefficient[:, 2] == pytest.approx(TRUE[:, 2], rel=0.02)


def test_a_narrow_sweep_tells_the_first_term_and_leaves_the_rest_at_the_defaults():
    result = fit(*sweep(1.0))
    assert (result.coefficient_std[:, 0] < 0.1 * DEFAULT_STD[0]).all()
    assert (np.abs(result.coefficient[:, 0] - TRUE[:, 0]) < 3.5 * result.coefficient_std[:, 0]).all()
    assert result.coefficient[:, 2] == pytest.approx(np.full(3, DEFAULT[2]), rel=0.01)
    assert result.coefficient_std[:, 2] == pytest.approx(np.full(3, DEFAULT_STD[2]), rel=0.01)


def test_the_stated_standard_deviations_are_the_spread():
    # Coefficients drawn as plates differ: what is stated holds for the wide and the narrow sweep.
    rng = np.random.default_rng(5)
    for span in (2.0, 10.0, 40.0):
        kelvin = np.linspace(-span / 2, span / 2, 20) + REFERENCE_KELVIN + 3
        d = kelvin - REFERENCE_KELVIN
        true = DEFAULT + DEFAULT_STD * rng.normal(size=(4000, 3))
        shift = np.polynomial.polynomial.polyval(d, np.insert(true, 0, 0.0, axis=1).T).T
        shift = shift + 5e-9 * rng.normal(size=shift.shape)
        result = fit_temperature(kelvin, shift, np.full(4000, 5e-9), DEFAULT, DEFAULT_STD, REFERENCE_KELVIN)
        spread = np.std((result.coefficient - true) / result.coefficient_std, axis=0)
        assert spread == pytest.approx(np.ones(3), abs=0.05)
