import math

import numpy as np
import pytest

from resonator_daemon.base.plate import load_plate
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.estimate.forces.spread import SpreadFit

DEPTH_M = 2.5e-3
NOISE_STD = 1e-3
SITES_M = np.array([site.position_mm for site in load_plate("quartz16").sites]) * 1e-3
VARIANCE = np.full(16, NOISE_STD**2)


def site_force(position_m, force):
    """Force on each site below point loads, site by site."""
    felt, loads = [], list(zip(position_m, force, strict=True))
    for x, y in SITES_M:
        parts = [f * DEPTH_M**3 / math.hypot(x - px, y - py, DEPTH_M) ** 3 for (px, py), f in loads]
        felt.append(math.fsum(parts))
    return np.array(felt)


def information(position_m, force, variance):
    """Inverse of Fisher's matrix for one touch, derivatives by central differences."""
    parameters = np.array([*position_m, force])
    columns = []
    for i, step in enumerate((1e-7, 1e-7, 1e-4)):
        low, high = parameters.copy(), parameters.copy()
        low[i] -= step
        high[i] += step
        columns.append((site_force([high[:2]], high[2:]) - site_force([low[:2]], low[2:])) / (2 * step))
    jacobian = np.array(columns).T
    return np.linalg.inv((jacobian.T / variance) @ jacobian)


def test_a_touch_without_noise_comes_back():
    rng = np.random.default_rng(1)
    fit = SpreadFit(SITES_M, DEPTH_M, model_error=0.0)
    for _ in range(50):
        position, force = rng.uniform(-8e-3, 8e-3, 2), rng.uniform(0.2, 8.0)
        touches = fit.fit(site_force([position], [force]), VARIANCE)
        assert touches.status == "ok"
        assert touches.position_m == pytest.approx(position[None], abs=1e-7)
        assert touches.force_newton == pytest.approx([force], rel=1e-5)


def test_the_estimator_reaches_the_cramer_rao_bound():
    rng, draws = np.random.default_rng(2), 160
    fit = SpreadFit(SITES_M, DEPTH_M, model_error=0.0)
    squares, chi2 = [], []
    for position in ((0.0, 0.0), (2e-3, -5e-3), (-5e-3, 6.5e-3)):
        clean, bound = site_force([position], [1.0]), information(position, 1.0, VARIANCE)
        covariances = []
        for noise in NOISE_STD * rng.normal(size=(draws, 16)):
            touches = fit.fit(clean + noise, VARIANCE)
            error = np.array([*touches.position_m[0], touches.force_newton[0]]) - [*position, 1.0]
            squares.append(error @ np.linalg.solve(bound, error))
            covariances.append(touches.covariance[0])
            chi2.append(touches.chi2)
        scale = np.sqrt(np.outer(np.diag(bound), np.diag(bound)))
        assert np.mean(covariances, axis=0) / scale == pytest.approx(bound / scale, abs=0.02)
        assert math.sqrt(np.mean(squares[-draws:]) / 3) == pytest.approx(1.0, abs=0.115)  # 3.5 standard deviations
    assert math.sqrt(np.mean(squares) / 3) == pytest.approx(1.0, abs=0.062)  # more than three, of three times the draws
    assert np.mean(chi2) == pytest.approx(13.0, abs=0.8)


def draw_touches(rng, count, anywhere):
    while True:
        position = rng.uniform(-9e-3, 9e-3, (count, 2)) if anywhere else SITES_M[rng.choice(16, count, replace=False)]
        apart = np.linalg.norm(position[:, None] - position, axis=2) + np.eye(count)
        if apart.min() >= 5e-3:
            return position, rng.uniform(0.2, 8.0, count)


def test_two_touches_are_found_and_none_is_invented():
    """On sites and between them by turns."""
    rng, found, invented, draws = np.random.default_rng(3), 0, 0, 160
    fit = SpreadFit(SITES_M, DEPTH_M, model_error=0.015)
    for draw in range(draws):
        position, force = draw_touches(rng, 2, anywhere=bool(draw % 2))
        felt = site_force(position, force) * (1 + 0.015 * rng.normal(size=16)) + NOISE_STD * rng.normal(size=16)
        touches = fit.fit(felt, VARIANCE)
        invented += len(touches.force_newton) > 2
        distance = np.linalg.norm(touches.position_m[:, None] - position, axis=2)
        if len(touches.force_newton) == 2 and touches.status == "ok":
            found += min(max(distance[0, 0], distance[1, 1]), max(distance[0, 1], distance[1, 0])) < DEPTH_M
    assert found >= 0.99 * draws
    assert invented == 0


def test_a_single_touch_is_not_split():
    """On sites and between them by turns."""
    rng, split, rejected, ratios = np.random.default_rng(4), 0, 0, []
    fit = SpreadFit(SITES_M, DEPTH_M, model_error=0.015)
    for draw in range(300):
        position, force = draw_touches(rng, 1, anywhere=bool(draw % 2))
        felt = site_force(position, force) * (1 + 0.015 * rng.normal(size=16)) + NOISE_STD * rng.normal(size=16)
        touches = fit.fit(felt, VARIANCE)
        split += len(touches.force_newton) > 1
        rejected += touches.status != "ok"
        error = np.array([*(touches.position_m[0] - position[0]), touches.force_newton[0] - force[0]])
        ratios.append(error @ np.linalg.solve(touches.covariance[0], error))
    assert split == 0
    assert rejected <= 2  # 1e-3 by chance
    # Quantiles of chi2 with 3 degrees of freedom; a light touch at a corner may have its mirror image beyond the sites.
    assert np.median(ratios) == pytest.approx(2.366, abs=0.45)
    assert np.mean(np.array(ratios) <= 7.815) == pytest.approx(0.95, abs=0.02)


def test_noise_alone_is_no_touch():
    rng = np.random.default_rng(5)
    fit = SpreadFit(SITES_M, DEPTH_M, model_error=0.015)
    sigmas = rng.normal(size=(1000, 16))
    outcomes = [fit.fit(NOISE_STD * draw, VARIANCE) for draw in sigmas]
    assert sum(len(touches.force_newton) for touches in outcomes) == 0
    beyond = np.sum(sigmas**2, axis=1) > 39.252  # tabulated: 1e-3 with 16 degrees of freedom
    assert [touches.status == "rejected" for touches in outcomes] == beyond.tolist()


def test_sites_that_are_not_known_are_left_out():
    felt = site_force([(1e-3, 1e-3)], [2.0])
    felt[[0, 5]] = np.nan
    variance = VARIANCE.copy()
    variance[9] = np.nan
    touches = SpreadFit(SITES_M, DEPTH_M, model_error=0.0).fit(felt, variance)
    assert touches.position_m == pytest.approx(np.array([[1e-3, 1e-3]]), abs=1e-7)
    nothing = SpreadFit(SITES_M, DEPTH_M, model_error=0.0).fit(np.full(16, np.nan), VARIANCE)
    assert nothing.status == "no_signal"
    assert nothing.position_m.shape == (0, 2)


def test_forces_that_no_touches_explain_are_rejected():
    pulled = -site_force([(1e-3, 1e-3)], [2.0])
    touches = SpreadFit(SITES_M, DEPTH_M, model_error=0.0).fit(pulled, VARIANCE)
    assert touches.status == "rejected"
    assert touches.reason.code is ReasonCode.NO_TOUCHES_FIT
    pressed_everywhere = np.full(16, 2.0)
    pressed_everywhere[::2] = 0.1
    touches = SpreadFit(SITES_M, DEPTH_M, model_error=0.0).fit(pressed_everywhere, VARIANCE)
    assert touches.status == "rejected"
    assert len(touches.force_newton) <= 4


def test_touches_too_near_to_each_other_are_not_told_apart():
    near_m = np.array([[0.0, 0.0], [1.2e-3, 0.0]])
    for heavy in (1.0, 3.0, 6.0):
        found = SpreadFit(SITES_M, DEPTH_M, model_error=0.0).fit(site_force(near_m, [1.0, heavy]), 1e-6 * VARIANCE)
        apart = np.linalg.norm(found.position_m[:, None] - found.position_m, axis=2) + np.eye(len(found.position_m))
        assert apart.min(initial=1.0) >= 0.5 * DEPTH_M
