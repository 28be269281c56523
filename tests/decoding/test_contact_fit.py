"""The fit of few parameters against linear least squares, and against how errors really scatter."""

import numpy as np
import pytest

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.fitting.contact_fit import fit

RNG = np.random.default_rng(0)
COLUMNS = RNG.standard_normal((3, 200))
TRUE = np.array([0.5, -2.0, 1.0])
WIDE = np.full(3, 100.0)
NOISE = np.linspace(0.1, 0.3, 200)


def linear(parameters: Floats) -> tuple[Floats, Floats]:
    return parameters @ COLUMNS, COLUMNS


def bent(parameters: Floats) -> tuple[Floats, Floats]:
    """Parameters that enter as cubes."""
    return parameters**3 @ COLUMNS, 3.0 * parameters[:, None] ** 2 * COLUMNS


def test_linear_as_lstsq() -> None:
    signals = TRUE @ COLUMNS + NOISE * RNG.standard_normal(200)
    signals[[3, 50]] = np.nan
    known = np.isfinite(signals)
    expected, chi_square, *_ = np.linalg.lstsq((COLUMNS / NOISE)[:, known].T, (signals / NOISE)[known])
    found = fit(linear, np.zeros(3), -WIDE, WIDE, signals, NOISE)
    weighted = (COLUMNS / NOISE)[:, known]
    np.testing.assert_allclose(found.parameters, expected, atol=2e-3)
    np.testing.assert_allclose(found.chi_square, chi_square[0], rtol=1e-4)
    assert found.count == 198
    np.testing.assert_allclose(found.covariance / max(found.chi2, 1.0), np.linalg.inv(weighted @ weighted.T))


def test_nonlinear_with_honest_errors() -> None:
    scores = []
    for seed in range(100):
        signals = TRUE**3 @ COLUMNS + NOISE * np.random.default_rng(1000 + seed).standard_normal(200)
        found = fit(bent, TRUE + 0.3, -WIDE, WIDE, signals, NOISE)
        scores.append((found.parameters - TRUE) / np.sqrt(np.diag(found.covariance)))
    assert 0.85 < np.sqrt(np.mean(np.square(scores))) < 1.15


def test_stays_between_bounds_and_finds_the_best_there() -> None:
    signals = TRUE @ COLUMNS + NOISE * np.random.default_rng(2).standard_normal(200)
    upper = np.array([100.0, 100.0, 0.4])
    found = fit(linear, np.zeros(3), -WIDE, upper, signals, NOISE)
    assert found.parameters[2] == 0.4
    rest = (signals - 0.4 * COLUMNS[2]) / NOISE
    expected, *_ = np.linalg.lstsq((COLUMNS[:2] / NOISE).T, rest)
    np.testing.assert_allclose(found.parameters[:2], expected, atol=2e-3)


def test_what_leaves_no_trace_has_no_finite_error() -> None:
    def blind(parameters: Floats) -> tuple[Floats, Floats]:
        seen = COLUMNS * np.array([[1.0], [1.0], [0.0]])
        return parameters @ seen, seen

    assert np.isinf(fit(blind, np.zeros(3), -WIDE, WIDE, COLUMNS[0], NOISE).covariance).all()


def test_share_of_energy_that_nothing_explains() -> None:
    def first(parameters: Floats) -> tuple[Floats, Floats]:
        return parameters @ COLUMNS[:1], COLUMNS[:1]

    signals = 10.0 * COLUMNS[0] + 5.0 * COLUMNS[1] + NOISE * np.random.default_rng(3).standard_normal(200)
    found = fit(first, np.zeros(1), -WIDE[:1], WIDE[:1], signals, np.full(200, 0.2))
    left = signals - COLUMNS[0] * (signals @ COLUMNS[0]) / (COLUMNS[0] @ COLUMNS[0])
    assert found.unexplained == pytest.approx((left @ left) / (signals @ signals), rel=0.01)
    assert found.doubt
    assert not fit(linear, np.zeros(3), -WIDE, WIDE, signals, NOISE).doubt
