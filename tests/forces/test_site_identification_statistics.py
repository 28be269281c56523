import numpy as np
import pytest
from brute_force_board import Ladder
from drawn_touches import COMMON_MODE_STD, COUNTER_STD, MODEL_ERROR, OSCILLATOR_STD, draws, match_all, matcher_of, wrong


@pytest.mark.parametrize("mixed_sign", [False, True])
def test_statistics_of_the_matcher_on_a_400_ppm_ladder(mixed_sign):
    plate = Ladder(mixed_sign=mixed_sign)
    site, force, frequency = draws(plate, 20_000, seed=11)
    matches = match_all(matcher_of(plate), frequency)
    ok = matches.status == "ok"
    assert (ok | (matches.status == "rejected")).all()
    assert wrong(matches, site) == 0
    assert np.mean(~ok) == pytest.approx(1e-3, abs=6e-4)
    assert np.mean(matches.chi2) == pytest.approx(3.0, abs=0.08)
    # The bound by full matrices, of the true force.
    k = plate.sensitivity[site][ok]
    covariance = (COUNTER_STD**2 + (MODEL_ERROR * k * force[ok, None]) ** 2)[:, None, :] * np.eye(4)
    covariance += OSCILLATOR_STD**2 + COMMON_MODE_STD**2
    information = np.einsum("nc,nc->n", k, np.linalg.solve(covariance, k[..., None])[..., 0])
    standardised = (matches.force_newton - force)[ok] * np.sqrt(information)
    assert np.sqrt(np.mean(standardised**2)) <= 1.02
    assert abs(np.mean(standardised)) < 0.03
    # What is stated is neither much larger nor smaller than what is wrong.
    assert np.std((matches.force_newton - force)[ok] / matches.stated_newton[ok]) == pytest.approx(1.0, abs=0.03)
