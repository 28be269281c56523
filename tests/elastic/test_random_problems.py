"""Two hundred mixed problems drawn at random: each solved to its tolerance, or refused by name and rightly so."""

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest
from dense_surface import dense_compliance

from resonator_daemon.arrays import Bools, Floats
from resonator_daemon.elastic import HalfSpace, SpectralGrid
from resonator_daemon.elastic.contact import press
from resonator_daemon.elastic.influence import SurfaceCompliance
from resonator_daemon.elastic.mixed import MixedBoundary
from resonator_daemon.elastic.regions import solve_regions

NAMES = ("u_x", "u_y", "u_z", "f_x", "f_y", "f_z")
TRIPLES = list(combinations(NAMES, 3))
AXIS_WISE = [triple for triple in TRIPLES if len({name[2] for name in triple}) == 3]
TOLERANCE = 1e-8


class Problem:
    """A body and its pixels, drawn at random, and the dense matrix of its surface."""

    def __init__(self, rng: np.random.Generator, *, periodic: bool) -> None:
        self.rng = rng
        self.nu = float(rng.choice([-0.7, 0.0, 0.3, 0.49, 0.5, rng.uniform(-0.9, 0.5)]))
        self.mu = 10.0 ** rng.uniform(3, 11)
        self.shape = (int(rng.integers(5, 14)), int(rng.integers(5, 14)))
        self.pitch_m = 10.0 ** rng.uniform(-6, -2)
        self.periodic = periodic
        self.matrix = dense_compliance(self.shape, self.nu, self.mu, self.pitch_m, periodic=periodic)
        self.body = HalfSpace(2 * self.mu * (1 + self.nu), self.nu)
        self.compliance = SurfaceCompliance(self.body, self.shape, self.pitch_m, periodic)
        self.pascal = 10.0 ** rng.uniform(-2, 6)
        self.metres = self.pascal * self.matrix.diagonal().max()

    def displacement(self, traction: Floats) -> Floats:
        return (self.matrix @ traction.ravel()).reshape(traction.shape)

    def region(self) -> Bools:
        """A disc, a block, or scattered pixels."""
        y, x = np.indices(self.shape)
        a, b = (self.rng.uniform(0, n) for n in self.shape)
        kind = self.rng.integers(3)
        if kind == 0:
            return np.hypot(y - a, x - b) < self.rng.uniform(1, max(self.shape))
        if kind == 1:
            return (y < a) & (x < b)
        return self.rng.random(self.shape) < self.rng.random()


def same_everywhere(problem: Problem) -> bool:
    """Case 2: tractions of no mean. Whether it was solved."""
    rng = problem.rng
    known = TRIPLES[rng.integers(len(TRIPLES))]
    grid = SpectralGrid(problem.shape, problem.pitch_m)
    if known not in AXIS_WISE:
        with pytest.raises(ValueError, match=f"known is {', '.join(known)}, which .* of u_i and f_i"):
            MixedBoundary(problem.body, grid, known, zero="periodic")
        return False
    boundary = MixedBoundary(problem.body, grid, known, zero="periodic")
    scale = {"u": problem.metres, "f": problem.pascal}
    values = np.array([scale[name[0]] * rng.normal(size=problem.shape) for name in known])
    values -= values.mean(axis=(1, 2), keepdims=True)
    traction, displacement = (boundary.field(values, output) for output in ("traction", "displacement"))
    six = dict(zip(NAMES, [*problem.displacement(traction), *traction], strict=True))
    for name, value in zip(known, values, strict=True):
        of_all = displacement if name[0] == "u" else traction
        np.testing.assert_allclose(six[name], value, atol=1e-12 * np.abs(of_all).max())
    return True


def known_region(problem: Problem) -> bool:
    """Case 3, and the exact solution of its linear equations. Whether it was solved."""
    rng = problem.rng
    choices = [AXIS_WISE, AXIS_WISE, TRIPLES][rng.integers(3)]
    mixes = [choices[rng.integers(len(choices))] for _ in range(2)]
    region = problem.region()
    traction, displacement = np.full((2, 3, *problem.shape), np.nan)
    pascal = problem.pascal * rng.integers(2)  # in half of them what is not held is free
    for part, mix in zip((region, ~region), mixes, strict=True):
        for name in mix:
            field, scale = (displacement, problem.metres) if name[0] == "u" else (traction, pascal)
            field["xyz".index(name[2])][part] = scale * rng.normal(size=np.count_nonzero(part))
    held = np.isfinite(displacement)
    if (held == np.isfinite(traction)).any():
        with pytest.raises(ValueError, match=r"traction_pascal and displacement_m give (both|neither) f_"):
            solve_regions(problem.compliance, traction, displacement)
        return False
    resultant = np.where(held.any(axis=(1, 2)) & (rng.random(3) < 0.4), rng.normal(size=3), np.nan)
    resultant *= problem.pascal * problem.pitch_m**2 * held[0].size
    if problem.periodic and (held.all(axis=(1, 2)) & np.isnan(resultant)).any():
        with pytest.raises(ValueError, match="on the whole of a periodic surface"):
            solve_regions(problem.compliance, traction, displacement, resultant_newton=resultant)
        return False

    found = solve_regions(problem.compliance, traction, displacement, resultant_newton=resultant, tolerance=TOLERANCE)
    f = found.traction_pascal
    np.testing.assert_array_equal(f[~held], traction[~held])
    balanced = np.isfinite(resultant)
    sums = f.sum(axis=(1, 2)) * problem.pitch_m**2
    np.testing.assert_allclose(sums[balanced], resultant[balanced], atol=1e-11 * np.abs(f).sum() * problem.pitch_m**2)
    assert not found.shift_m[~balanced].any()
    u = problem.displacement(f)
    np.testing.assert_allclose(found.displacement_m, u, atol=1e-11 * np.abs(u).max())
    missed = np.where(held, displacement + found.shift_m[:, None, None] - u, 0.0)
    assert np.linalg.norm(missed) <= 1.001 * TOLERANCE * problem.compliance.of_own_load * np.linalg.norm(f)

    free = held.ravel()
    sum_of_free = (np.eye(3)[balanced][:, :, None] * np.ones(region.size)).reshape(-1, free.size)[:, free]
    at_known = np.where(held, 0.0, traction)
    unbalanced = resultant[balanced] / problem.pitch_m**2 - at_known.sum(axis=(1, 2))[balanced]
    count, unit = len(sum_of_free), problem.metres / problem.pascal
    bordered = np.block(
        [[problem.matrix[np.ix_(free, free)] / unit, -sum_of_free.T], [sum_of_free, np.zeros((count, count))]]
    )
    wanted = displacement.ravel()[free] - (problem.matrix @ at_known.ravel())[free]
    exact = np.linalg.solve(bordered, np.concatenate([wanted / unit, unbalanced]))[: free.sum()]
    np.testing.assert_allclose(f.ravel()[free], exact, atol=1e-6 * np.abs(f).max())
    return True


def unknown_region(problem: Problem) -> bool:
    """Case 4, its conditions checked with the dense matrix: pressure where it touches, a gap where it does not."""
    rng = problem.rng
    y, x = (np.indices(problem.shape).T - (np.array(problem.shape) - 1) / 2).T
    shapes = [(x**2 + y**2) / 20, np.zeros(problem.shape), rng.normal(size=problem.shape)]
    profile = problem.metres * shapes[rng.integers(3)]
    if not problem.periodic:
        profile[[0, -1]] = profile[:, [0, -1]] = np.inf  # no object above the border
    load = float(rng.uniform(0.05, 2)) * problem.pascal * problem.pitch_m**2 * profile.size
    found = press(problem.compliance, profile, load_newton=load, tolerance=TOLERANCE)
    p = found.pressure_pascal
    assert (p >= 0.0).all()
    assert p.sum() * problem.pitch_m**2 == pytest.approx(load, rel=1e-11)
    assert not p[np.isinf(profile)].any()
    u_z = problem.displacement(np.array([0 * p, 0 * p, p]))[2]
    gap = u_z + profile - found.approach_m
    natural = p - np.maximum(p - gap / problem.compliance.of_own_load, 0.0)
    assert np.linalg.norm(natural) <= 1.001 * TOLERANCE * np.linalg.norm(p)
    return True


@pytest.mark.parametrize(
    ("case", "periodic", "count", "solved_min"),
    [
        (same_everywhere, True, 40, 10),
        (known_region, False, 60, 25),
        (known_region, True, 40, 15),
        (unknown_region, False, 30, 30),
        (unknown_region, True, 30, 30),
    ],
)
def test_random_problems(case: Callable[[Problem], bool], periodic: bool, count: int, solved_min: int):
    solved = sum(case(Problem(np.random.default_rng((seed, periodic)), periodic=periodic)) for seed in range(count))
    assert solved >= solved_min  # the others were refused, and had to be
