import numpy as np
import pytest
from scipy.optimize import minimize

from resonator_daemon.estimate.surface.contact_physics.net_load import LoadSums
from resonator_daemon.estimate.surface.contact_physics.pixels import PixelLattice, PixelPrior
from resonator_daemon.estimate.surface.contact_physics.signal_rows import SignalRows
from resonator_daemon.estimate.surface.contact_physics.support_problem import SupportProblem, project_on_cone
from resonator_daemon.estimate.surface.contact_physics.support_rows import Model

LENGTH_M, RATIO, STD_PASCAL, NOISE_STD = 1e-3, 0.3, 50.0, 1.7
ROWS, COLUMNS, SITES, PITCH_M = 5, 6, (6, 6), 4e-4
EMPTY = 4  # pixels around the lattice that carry no load, either


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


def fields(scene, sites):
    return scene[1].reshape(3, ROWS, COLUMNS, 3, *sites)


def dense(scene, known=None, support=None):
    """A (signals, 3 n) and the prior covariance of the traction given that all around is 0, in double precision."""
    centres_m, kernel, drawn = scene
    support = drawn if support is None else support
    pixels = np.flatnonzero(support)
    y, x = np.divmod(np.arange((ROWS + 2 * EMPTY) * (COLUMNS + 2 * EMPTY)), COLUMNS + 2 * EMPTY)
    wide_m = (np.column_stack([x, y]) - EMPTY) * PITCH_M
    loaded_m = centres_m[pixels]
    off_m = np.linalg.norm(wide_m[:, None] - loaded_m, axis=-1)
    empty_m = wide_m[off_m.min(axis=1) > 1e-9]
    correlation, across, among = (
        np.exp(-np.linalg.norm(one[:, None] - other, axis=-1) / LENGTH_M)
        for one, other in ((loaded_m, loaded_m), (loaded_m, empty_m), (empty_m, empty_m))
    )
    correlation -= across @ np.linalg.solve(among, across.T)
    correlation *= STD_PASCAL**2
    prior = np.kron(np.diag([RATIO, RATIO, 1.0]), correlation)
    matrix = kernel[:, pixels].astype(float).reshape(3 * pixels.size, -1).T
    if known is not None:
        matrix = matrix[known]
    return matrix, prior


def problem_of(scene, rows, lost=None, support=None, before=None):
    prior = PixelPrior(PixelLattice((0.0, 0.0), PITCH_M, (ROWS, COLUMNS)), LENGTH_M)
    model = Model(rows.kernel, prior, RATIO, lost, STD_PASCAL, NOISE_STD, 6.0)
    return SupportProblem(model, (scene[2] if support is None else support).ravel(), before)


def everywhere(problem):
    return np.ones(problem.pixels.size, bool), np.zeros((3, problem.pixels.size), np.float32)


@pytest.mark.parametrize("shape", [None, SITES])
def test_linear_solution_is_the_bayes_estimate(scene, shape):
    rows = SignalRows(fields(scene, shape or (36,)))
    problem = problem_of(scene, rows)
    signals = np.random.default_rng(1).standard_normal(108).astype(np.float32) * 3.0
    matrix, prior = dense(scene)
    expected = prior @ matrix.T @ np.linalg.solve(matrix @ prior @ matrix.T + NOISE_STD**2 * np.eye(108), signals)
    found = problem.linear(problem.right_side(rows.project(signals)), *everywhere(problem))
    # A basis that leaves out a thousandth of the pixels' power changes some per cent of what noise alone decides.
    np.testing.assert_allclose(
        found.ravel(), expected, atol=(0.003 if shape is None else 0.06) * np.abs(expected).max()
    )


def test_a_problem_made_from_another_is_the_same(scene):
    rows = SignalRows(fields(scene, (36,)))
    moved = np.roll(scene[2], 1, 1)
    one = problem_of(scene, rows)
    other = problem_of(scene, rows, support=moved, before=one)
    back = problem_of(scene, rows, before=other)
    assert (one.updates, other.updates, back.updates) == (0, 1, 2)
    signals = np.random.default_rng(1).standard_normal(108).astype(np.float32) * 3.0
    for problem, support in ((other, moved), (back, scene[2])):
        matrix, prior = dense(scene, support=support)
        expected = prior @ matrix.T @ np.linalg.solve(matrix @ prior @ matrix.T + NOISE_STD**2 * np.eye(108), signals)
        order = np.argsort(problem.pixels)
        found = problem.linear(problem.right_side(signals), *everywhere(problem))[:, order]
        np.testing.assert_allclose(found.ravel(), expected, atol=0.003 * np.abs(expected).max())
        afresh = problem_of(scene, rows, support=support)
        np.testing.assert_allclose(problem.std()[:, order], afresh.std(), rtol=1e-5)


@pytest.mark.parametrize("shape", [None, SITES])
def test_lost_signals_drop_out(scene, shape):
    rng = np.random.default_rng(2)
    rows = SignalRows(fields(scene, shape or (36,)))
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


def test_the_constrained_solution_is_that_of_a_projected_gradient(scene):
    problem = problem_of(scene, SignalRows(fields(scene, (36,))))
    inside, start = everywhere(problem)
    inside[3] = False
    signals = np.random.default_rng(3).standard_normal(108) * 3.0
    matrix, prior = dense(scene)
    hessian = matrix.T @ matrix / NOISE_STD**2 + np.linalg.inv(prior)
    step, expected = 1.0 / np.linalg.eigvalsh(hessian)[-1], start.astype(float)
    for _ in range(4000):
        downhill = matrix.T @ signals / NOISE_STD**2 - hessian @ expected.ravel()
        moved = expected + step * downhill.reshape(3, -1)
        expected = project_on_cone(moved.astype(np.float32), 0.5).astype(float) * inside

    right_side = problem.right_side(signals.astype(np.float32))
    half = problem.constrained(right_side, 0.5, inside, start, start, 200)
    found, _ = problem.constrained(right_side, 0.5, inside, *half, 200)
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())
    assert not found[:, 3].any()
    assert (found[2] > 0.0).any()
    at_once, _ = problem.constrained(right_side, 0.5, inside, start, start, 400)
    np.testing.assert_allclose(found, at_once, rtol=1e-5, atol=1e-5)


def test_chi2_counts_what_is_left(scene):
    rows = SignalRows(fields(scene, (36,)))
    problem = problem_of(scene, rows)
    traction = np.random.default_rng(5).standard_normal((3, problem.pixels.size)).astype(np.float32)
    matrix, _ = dense(scene)
    left = np.random.default_rng(6).standard_normal(108)
    signals = (matrix @ traction.ravel() + left).astype(np.float32)
    assert problem.chi2(signals, problem.right_side(signals), traction) == pytest.approx(np.mean(left**2), rel=1e-4)


def test_net_load_scatters_as_its_standard_error_says(scene):
    rows = SignalRows(fields(scene, (36,)))
    problem = problem_of(scene, rows)
    matrix, prior = dense(scene)
    rng = np.random.default_rng(7)
    arms_m = scene[0][problem.pixels]
    root = np.linalg.cholesky(prior)
    sums = LoadSums(problem, scene[2].ravel().astype(np.int32), scene[0], 1.6e-7)
    z = []
    for _ in range(150):
        load = root @ rng.standard_normal(len(prior))
        signals = matrix @ load + NOISE_STD * rng.standard_normal(108)
        (net,) = sums.loads([problem.pixels], problem.right_side(signals.astype(np.float32)), 1.0)
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


def test_without_noise_the_error_of_a_load_is_that_of_its_pixels(scene):
    problem = problem_of(scene, SignalRows(fields(scene, (36,))))
    sums = LoadSums(problem, scene[2].ravel().astype(np.int32), scene[0], 1.6e-7)
    right_side = problem.right_side(np.random.default_rng(8).standard_normal(108).astype(np.float32))
    (load,) = sums.loads([problem.pixels], right_side, 0.0)
    force = np.linalg.norm(load.force_newton)
    lever_m = np.sqrt(np.mean(np.sum(scene[0][problem.pixels] ** 2, axis=1)))
    np.testing.assert_allclose(load.force_std_newton, np.array([3e-4, 3e-4, 2e-4]) * force)
    np.testing.assert_allclose(load.moment_std_newton_m, np.array([2e-4, 2e-4, 3e-4]) * lever_m * force)
    np.testing.assert_allclose(load.centroid_std_m, 2e-4 * np.sqrt(1.6e-7 * problem.pixels.size / np.pi))


@pytest.mark.parametrize("friction", [0.3, 1.0, 3.0])
def test_projection_is_the_nearest_traction_in_the_cone(friction):
    rng = np.random.default_rng(1)
    outside = rng.standard_normal((3, 40)).astype(np.float32)
    projected = project_on_cone(outside, friction)
    for before, after in zip(outside.T.astype(float), projected.T, strict=True):
        # In polar coordinates of the shear the cone is two straight bounds, which a general optimiser can take.
        best = minimize(
            lambda p, f=before: (p[0] - np.hypot(f[0], f[1])) ** 2 + (p[1] - f[2]) ** 2,
            [0.0, 1.0],
            constraints={"type": "ineq", "fun": lambda p: [friction * p[1] - p[0], p[0], p[1]]},
            options={"ftol": 1e-14},
        )
        direction = before[:2] / np.hypot(*before[:2])
        np.testing.assert_allclose(after, [*(best.x[0] * direction), best.x[1]], atol=2e-5)
