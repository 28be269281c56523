"""Tests of the problem on a support: dense algebra in double precision, and loads drawn from its own prior."""

import numpy as np
import pytest

from resonator_daemon.decoding.contact_physics.net_load import LoadSums
from resonator_daemon.decoding.contact_physics.signal_rows import SignalRows
from resonator_daemon.decoding.contact_physics.support_problem import SupportProblem

LENGTH_M, RATIO, STD_PASCAL, NOISE_STD = 1e-3, 0.3, 50.0, 1.7
ROWS, COLUMNS, SITES = 5, 6, (6, 6)


@pytest.fixture(scope="module")
def scene():
    """Centres, a smooth kernel (3, pixels, 3, sites), and a support."""
    rng = np.random.default_rng(4)
    y, x = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    centres_m = np.column_stack([x, y]) * 4e-4
    sy, sx = np.divmod(np.arange(36), 6)
    sites_m = np.column_stack([sx, sy]) * 4e-4
    offsets = (sites_m - centres_m[:, None]) / 8e-4
    bump = np.exp(-np.sum(offsets**2, axis=-1))
    kernel = 0.02 * np.stack(
        [
            np.stack([a * bump + b * offsets[..., 0] * bump + c * offsets[..., 1] * bump for a, b, c in row], axis=1)
            for row in rng.standard_normal((3, 3, 3))
        ]
    )
    support = np.zeros((ROWS, COLUMNS), bool)
    support[1:4, 1:5] = True
    return centres_m, kernel.astype(np.float32), support


def dense(scene, known=None, around=None):
    """A (signals, 3 n) and the prior covariance of the traction, in double precision."""
    centres_m, kernel, support = scene
    pixels = np.flatnonzero(support)
    distance = np.linalg.norm(centres_m[pixels][:, None] - centres_m[pixels], axis=-1)
    correlation = np.exp(-distance / LENGTH_M)
    if around is not None:  # a Gaussian field given that it is 0 there
        empty = centres_m[around]
        across = np.exp(-np.linalg.norm(centres_m[pixels][:, None] - empty, axis=-1) / LENGTH_M)
        among = np.exp(-np.linalg.norm(empty[:, None] - empty, axis=-1) / LENGTH_M)
        correlation = correlation - across @ np.linalg.solve(among, across.T)
    correlation *= STD_PASCAL**2
    prior = np.kron(np.diag([RATIO, RATIO, 1.0]), correlation)
    matrix = kernel[:, pixels].astype(float).reshape(3 * pixels.size, -1).T
    if known is not None:
        matrix = matrix[known]
    return matrix, prior


def problem_of(scene, rows, lost=None, around=None):
    centres_m, _, support = scene
    around = np.zeros(support.size, bool) if around is None else around
    return SupportProblem(rows.kernel, centres_m, support.ravel(), around, STD_PASCAL, NOISE_STD, LENGTH_M, RATIO, lost)


def everywhere(problem):
    return np.ones(problem.pixels.size, bool), np.zeros((3, problem.pixels.size), np.float32)


@pytest.mark.parametrize("shape", [None, SITES])
def test_linear_solution_is_the_bayes_estimate(scene, shape):
    rows = SignalRows(scene[1], shape)
    problem = problem_of(scene, rows)
    signals = np.random.default_rng(1).standard_normal(108).astype(np.float32) * 3.0
    matrix, prior = dense(scene)
    expected = prior @ matrix.T @ np.linalg.solve(matrix @ prior @ matrix.T + NOISE_STD**2 * np.eye(108), signals)
    found = problem.linear(problem.right_side(rows.project(signals)), *everywhere(problem))
    # A basis that leaves out a thousandth of the pixels' power changes some per cent of what noise alone decides.
    np.testing.assert_allclose(
        found.ravel(), expected, atol=(0.003 if shape is None else 0.06) * np.abs(expected).max()
    )


def test_pixels_known_to_be_empty_tell_about_the_others(scene):
    rows = SignalRows(scene[1], None)
    around = ~scene[2].ravel()
    problem = problem_of(scene, rows, around=around)
    signals = np.random.default_rng(1).standard_normal(108).astype(np.float32) * 3.0
    matrix, prior = dense(scene, around=around)
    expected = prior @ matrix.T @ np.linalg.solve(matrix @ prior @ matrix.T + NOISE_STD**2 * np.eye(108), signals)
    found = problem.linear(problem.right_side(signals), *everywhere(problem))
    np.testing.assert_allclose(found.ravel(), expected, atol=0.003 * np.abs(expected).max())


@pytest.mark.parametrize("shape", [None, SITES])
def test_lost_signals_drop_out(scene, shape):
    rng = np.random.default_rng(2)
    rows = SignalRows(scene[1], shape)
    known = rng.random(108) > 0.3
    lost = rows.whitener(known)
    problem = problem_of(scene, rows, lost)
    signals = rng.standard_normal(108) * 3.0 * known
    matrix, prior = dense(scene, known)
    inner = matrix @ prior @ matrix.T + NOISE_STD**2 * np.eye(known.sum())
    expected = prior @ matrix.T @ np.linalg.solve(inner, signals[known])
    rows_of_frame = lost.signals(rows.project(signals.astype(np.float32)))
    found = problem.linear(problem.right_side(rows_of_frame), *everywhere(problem))
    np.testing.assert_allclose(found.ravel(), expected, atol=(0.003 if shape is None else 0.1) * np.abs(expected).max())


def test_pixels_outside_the_mask_stay_empty(scene):
    rows = SignalRows(scene[1], None)
    problem = problem_of(scene, rows)
    inside, start = everywhere(problem)
    inside[3] = False
    signals = np.random.default_rng(3).standard_normal(108).astype(np.float32)
    found = problem.linear(problem.right_side(signals), inside, start)
    assert not found[:, 3].any()
    assert found[:, 4].all()


def test_chi2_counts_what_is_left(scene):
    rows = SignalRows(scene[1], None)
    problem = problem_of(scene, rows)
    traction = np.random.default_rng(5).standard_normal((3, problem.pixels.size)).astype(np.float32)
    matrix, _ = dense(scene)
    left = np.random.default_rng(6).standard_normal(108)
    signals = (matrix @ traction.ravel() + left).astype(np.float32)
    assert problem.chi2(signals, traction) == pytest.approx(np.mean(left**2), rel=1e-4)


def test_net_load_scatters_as_its_standard_error_says(scene):
    rows = SignalRows(scene[1], None)
    problem = problem_of(scene, rows)
    inside, _ = everywhere(problem)
    matrix, prior = dense(scene)
    rng = np.random.default_rng(7)
    centres_m = scene[0][problem.pixels]
    arms_m = centres_m - centres_m.mean(axis=0)
    root = np.linalg.cholesky(prior)
    sums = LoadSums(problem, inside, centres_m, tuple(centres_m.mean(axis=0)), 1.6e-7)
    z = []
    for _ in range(150):
        load = root @ rng.standard_normal(len(prior))
        signals = matrix @ load + NOISE_STD * rng.standard_normal(108)
        net = sums.load(problem.right_side(signals.astype(np.float32)), 1.0)
        f_x, f_y, f_z = load.reshape(3, -1) * 1.6e-7
        force = np.array([f_x.sum(), f_y.sum(), f_z.sum()])
        x, y = arms_m.T
        moment = np.array([y @ f_z, -x @ f_z, x @ f_y - y @ f_x])
        z.append(
            [
                *((net.force_newton - force) / net.force_std_newton),
                *((net.moment_newton_m - moment) / net.moment_std_newton_m),
            ]
        )
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    # Shear of real contacts scatters 1.2 times as much as the prior's loads.
    np.testing.assert_allclose(rms, 1.0 / np.array([1.2, 1.2, 1.0, 1.0, 1.0, 1.2]), rtol=0.2)
