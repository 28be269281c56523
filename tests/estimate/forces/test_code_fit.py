import numpy as np
import pytest
from scipy.stats import chi2 as chi2_distribution

from resonator_daemon.estimate.forces.code_fit import Code, Codes, Reading, fit_code, gates, uncertainty_newton

LOW, HIGH = -0.5, 10.0


@pytest.mark.parametrize("seed", range(60))
def test_a_fit_is_that_of_the_full_matrices(seed):
    draw = np.random.default_rng(seed)
    k = 6.3e-6 * draw.choice([-1.0, 1.0], 4) * draw.uniform(0.5, 1.5, 4)
    f0_hz, std, model_error = draw.uniform(9e6, 11e6, 4), 10.0 ** draw.uniform(-9, -7, 4), draw.uniform(0.0, 0.05)
    oscillator, common_mode = 10.0 ** draw.uniform(-20, -16, 2)
    used = draw.random(4) < 0.7
    used[:2] = True
    # Beyond both ends of the range, too.
    shift = k * draw.uniform(-1.0, 12.0) + 1e-7 * draw.standard_normal(4)
    frequency_hz, variance = np.where(used, f0_hz / (1.0 - shift), 1.0), np.where(used, std**2, 0.0)
    inverse_variance = np.where(used, std**-2, 0.0)
    reading = Reading(
        frequency_hz.tolist(), variance.tolist(), inverse_variance.tolist(), float(oscillator), float(common_mode)
    )
    codes = Codes([Code([], []), Code(f0_hz.tolist(), k.tolist())], model_error, (LOW, HIGH))
    found = fit_code(codes, 1, reading)

    y, k, common = shift[used], k[used], oscillator + common_mode
    counter = np.diag(variance[used])
    covariance = counter + common
    information = k @ np.linalg.solve(covariance, k)
    first = np.clip(k @ np.linalg.solve(covariance, y) / information, LOW, HIGH)
    covariance += np.diag((model_error * k) ** 2 * (first**2 + 3.0**2 / information))
    inverse = np.linalg.inv(covariance)
    weights = k @ inverse / (k @ inverse @ k)
    residual = y - k * np.clip(weights @ y, LOW, HIGH)
    chi2 = residual @ inverse @ residual
    assert found.site == 1
    assert np.array(found.weights)[used] == pytest.approx(weights, rel=1e-9, abs=1e-9 * np.abs(weights).max())
    assert not np.array(found.weights)[~used].any()
    assert found.force_newton == pytest.approx(weights @ y, rel=1e-9)
    assert found.chi2 == pytest.approx(chi2, rel=1e-7)
    assert found.score == pytest.approx(chi2 + np.linalg.slogdet(covariance)[1], rel=1e-7)
    noise, systematic = uncertainty_newton(codes, 1, found.force_newton, found.weights, reading)
    assert noise == pytest.approx(np.sqrt(weights @ (counter + oscillator) @ weights), rel=1e-9)
    of_model = np.diag((model_error * k * found.force_newton) ** 2) + common_mode
    assert systematic == pytest.approx(np.sqrt(weights @ of_model @ weights), rel=1e-9)
    only = tuple(np.flatnonzero(used)[:2].tolist())
    assert reading.channels == tuple(np.flatnonzero(used).tolist())
    assert reading.on(only).channels == only


def test_gates_are_exceeded_once_in_a_thousand_touches():
    freedom = [1, 1, 1, 2, 3, 4, 5, 6, 7]
    assert gates(8) == pytest.approx(chi2_distribution.isf(1e-3, freedom), rel=1e-12)
