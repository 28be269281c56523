"""Mixed conditions everywhere and by region: boundary-value problems in many digits, rigid punches, dense algebra."""

from itertools import combinations, product

import numpy as np
import pytest
from boundary_value_problem import BoundaryValueProblem, mp
from dense_surface import dense_compliance

from resonator_daemon.base.arrays import Complexes, Floats
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance
from resonator_daemon.estimate.elastic.mixed import MixedBoundary, Quantity, RegionSolution, solve_regions

E, PITCH_M = 2e5, 4e-4
NAMES: tuple[Quantity, ...] = ("u_x", "u_y", "u_z", "f_x", "f_y", "f_z")
TRIPLES = list(combinations(NAMES, 3))
CONJUGATE = [triple for triple in TRIPLES if {name[2] for name in triple} == set("xyz")]
SINGULAR = [triple for triple in TRIPLES if triple not in CONJUGATE]
OUTPUT_DEPTHS = [("traction", 0.0), ("displacement", 0.0), ("displacement", 3e-4), ("strain", 3e-4), ("stress", 5e-4)]

MU, PUNCH_PITCH_M = 7e4, 4e-4
NU = [-0.5, 0.0, 0.3, 0.5]


def wave(grid: SpectralGrid, wx: float, wy: float, amplitudes: Complexes) -> Floats:
    """Real part of amplitudes (rows,) times exp(j omega r), sampled."""
    y, x = (np.arange(n) * grid.pitch_m for n in grid.shape)
    return np.real(amplitudes[:, None, None] * np.exp(1j * (wx * x + wy * y[:, None])))


def pick(grid: SpectralGrid, known: tuple[Quantity, ...], displacement: Floats, traction: Floats) -> Floats:
    six = dict(zip(NAMES, [*displacement, *traction], strict=True))
    return np.array([six[name] for name in known])


@pytest.mark.parametrize("nu", [-0.6, 0.0, 0.3, 0.5])
@pytest.mark.parametrize("bin_", [(0, 2), (3, 0), (2, 5), (-3, 1)])
def test_every_axis_wise_mix_gives_the_wave_that_elasticity_has(nu: float, bin_: tuple[int, int]):
    """The truth is solved from equilibrium and Hooke's law, without any matrix of ours."""
    grid = SpectralGrid((9, 14), PITCH_M)
    body = HalfSpace(E, nu)
    wy, wx = (2 * np.pi * index / (n * PITCH_M) for index, n in zip(bin_, grid.shape, strict=True))
    problem = BoundaryValueProblem(mp.mpf(wx), mp.mpf(wy), mp.mpf(nu), mp.mpf(body.shear_modulus_pascal))
    load = np.array([300.0 - 100.0j, 250.0 + 40.0j, -80.0 + 500.0j])
    at_depth = {depth: problem.matrices("traction", mp.mpf(depth)) for depth in (0.0, 3e-4, 5e-4)}

    def truth(output: str, depth: float) -> Floats:
        matrix = np.array(at_depth[depth][output].tolist(), dtype=complex) if output != "traction" else np.eye(3)
        return wave(grid, wx, wy, matrix @ load)

    displacement, traction = truth("displacement", 0.0), truth("traction", 0.0)
    for known in CONJUGATE:
        boundary = MixedBoundary(body, grid, known, zero="periodic")
        values = pick(grid, known, displacement, traction)
        for output, depth in OUTPUT_DEPTHS:
            expected = truth(output, depth)
            found = boundary.field(values, output, depth)
            np.testing.assert_allclose(
                found, expected, atol=3e-14 * np.abs(expected).max(), err_msg=f"{known} {output}"
            )


@pytest.mark.parametrize("zero", ["periodic", "isolated"])
@pytest.mark.parametrize("shape", [(8, 8), (7, 7), (1, 1)])
def test_a_traction_comes_back_from_any_three_that_it_made(zero: str, shape: tuple[int, int]):
    """Nyquist frequencies and means included; the order of the known is the caller's."""
    rng = np.random.default_rng(5)
    grid = SpectralGrid(shape, PITCH_M)
    for nu, known in product((0.2, 0.5), CONJUGATE):
        body = HalfSpace(E, nu)
        traction = rng.normal(size=(3, *shape))
        if zero == "periodic":  # a mean traction pushes such a body away for ever
            for name in known:
                if name[0] == "u":
                    traction["xyz".index(name[2])] -= traction["xyz".index(name[2])].mean()
        by_traction = MixedBoundary(body, grid, ("f_x", "f_y", "f_z"), zero=zero)
        displacement = by_traction.field(traction, "displacement")
        order = rng.permutation(3)
        shuffled = tuple(known[i] for i in order)
        boundary = MixedBoundary(body, grid, shuffled, zero=zero)
        values = pick(grid, shuffled, displacement, traction)
        np.testing.assert_allclose(boundary.field(values, "traction"), traction, atol=1e-13)
        scale = np.abs(displacement).max()
        np.testing.assert_allclose(boundary.field(values, "displacement"), displacement, atol=1e-13 * scale)
        deep = by_traction.field(traction, "p_n", 2e-4)
        np.testing.assert_allclose(boundary.field(values, "p_n", 2e-4), deep, atol=1e-13)


def test_means_of_a_body_that_repeats():
    """A mean displacement moves the body as a whole; a mean traction compresses it, confined to its period."""
    nu, depth = 0.3, 1e-3
    body, grid = HalfSpace(E, nu), SpectralGrid((6, 4), PITCH_M)
    boundary = MixedBoundary(body, grid, ("f_z", "u_y", "u_x"), zero="periodic")
    values = np.broadcast_to(np.array([70.0, 2e-6, 5e-6])[:, None, None], (3, 6, 4))

    def uniform(output: str, at_m: float) -> Floats:
        field = boundary.field(values, output, at_m)
        np.testing.assert_allclose(field, np.broadcast_to(field[:, :1, :1], field.shape), rtol=1e-14)
        return field[:, 0, 0]

    oedometric_modulus = E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    np.testing.assert_allclose(uniform("traction", 0.0), [0, 0, 70.0], atol=1e-13)
    np.testing.assert_allclose(uniform("displacement", 0.0), [5e-6, 2e-6, 0], atol=1e-20)
    np.testing.assert_allclose(
        uniform("displacement", depth), [5e-6, 2e-6, -70.0 * depth / oedometric_modulus], rtol=1e-13
    )
    np.testing.assert_allclose(uniform("stress", depth), [-30.0, -30.0, -70.0, 0, 0, 0], rtol=1e-13, atol=1e-13)


def test_only_one_quantity_of_each_axis_determines_the_surface():
    for known in [*SINGULAR, ("u_x", "u_y", "w"), ("u_x", "u_y")]:
        with pytest.raises(ValueError, match=f"known is {', '.join(known)}, must be one of u_i and f_i"):
            MixedBoundary(HalfSpace(E, 0.3), SpectralGrid((7, 9), PITCH_M), known, zero="periodic")


def surface(nu: float, shape: tuple[int, int]) -> SurfaceCompliance:
    return SurfaceCompliance(HalfSpace(2 * MU * (1 + nu), nu), shape, PUNCH_PITCH_M)


class Punch:
    """A rigid disc of 20 pixels' radius; tractions 0 where no displacement is known."""

    def __init__(self) -> None:
        axis = (np.arange(48) - 23.5) * PUNCH_PITCH_M
        self.x, self.y = np.meshgrid(axis, axis)
        self.radius_m = 20 * PUNCH_PITCH_M
        self.under = np.hypot(self.x, self.y) <= self.radius_m

    def move(self, nu: float, held: str, displacement: list[Floats | float]) -> RegionSolution:
        known = np.array([self.under & (axis in held) for axis in "xyz"])
        moved = np.array([np.broadcast_to(u, self.x.shape) for u in displacement])
        return solve_regions(surface(nu, self.x.shape), np.where(known, np.nan, 0.0), np.where(known, moved, np.nan))

    def force(self, solution: RegionSolution) -> Floats:
        return solution.traction_pascal.sum(axis=(1, 2)) * PUNCH_PITCH_M**2


PUNCH = Punch()
A = PUNCH.radius_m


def bonded_stiffness(nu: float) -> float:
    """Mossakovskii 1954, Spence 1968."""
    return 4 * MU * A * (np.log(3 - 4 * nu) / (1 - 2 * nu) if nu < 0.5 else 2.0)


@pytest.mark.parametrize("nu", NU)
def test_frictionless_flat_punch(nu: float):
    """P = 2 E* a delta and p = P / (2 pi a sqrt(a^2 - r^2)), Boussinesq."""
    solution = PUNCH.move(nu, "z", [0, 0, 1e-5])
    load = 4 * MU / (1 - nu) * A * 1e-5
    assert PUNCH.force(solution)[2] == pytest.approx(load, rel=5e-3)
    r = np.hypot(PUNCH.x, PUNCH.y)
    inner = r < 0.8 * A
    pressure = load / (2 * np.pi * A * np.sqrt(A**2 - r[inner] ** 2))
    np.testing.assert_allclose(solution.traction_pascal[2][inner], pressure, rtol=0.015)
    near_edge = (r > 1.1 * A) & (r < 1.3 * A)
    np.testing.assert_allclose(
        solution.displacement_m[2][near_edge], 2e-5 / np.pi * np.arcsin(A / r[near_edge]), rtol=0.011
    )
    assert not solution.traction_pascal[:2].any()
    assert not solution.shift_m.any()


@pytest.mark.parametrize("nu", NU)
def test_bonded_flat_punch(nu: float):
    """The tangential tractions that bonding takes stiffen it by up to a fifth (nu = -0.5), not at nu = 1/2."""
    solution = PUNCH.move(nu, "xyz", [0, 0, 1e-5])
    assert PUNCH.force(solution) == pytest.approx([0, 0, bonded_stiffness(nu) * 1e-5], rel=6e-3, abs=1e-9)


@pytest.mark.parametrize("nu", NU)
def test_recovers_a_state_from_either_half_of_it(nu: float):
    """Made by a dense matrix that shares nothing with the code; then the known and the unknown change places."""
    rng = np.random.default_rng(11)
    shape = (9, 12)
    traction = rng.normal(size=(3, *shape))
    displacement = (dense_compliance(shape, nu, MU, PUNCH_PITCH_M) @ traction.ravel()).reshape(3, *shape)
    mask = rng.random((3, *shape)) < 0.5
    for region in (mask, ~mask):
        known = np.where(region, np.nan, traction), np.where(region, displacement, np.nan)
        solution = solve_regions(surface(nu, shape), *known, tolerance=1e-11)
        np.testing.assert_allclose(solution.traction_pascal, traction, atol=1e-9)
        np.testing.assert_allclose(solution.displacement_m, displacement, atol=1e-10 * np.abs(displacement).max())


def test_a_resultant_shifts_the_known_displacements_until_they_carry_it():
    rng = np.random.default_rng(4)
    shape = (8, 9)
    traction = rng.normal(size=(3, *shape))
    displacement = (dense_compliance(shape, 0.3, MU, PUNCH_PITCH_M) @ traction.ravel()).reshape(3, *shape)
    offset = np.array([3e-9, -1e-9, 2e-9])
    force_newton = traction.sum(axis=(1, 2)) * PUNCH_PITCH_M**2
    given, unknown = displacement - offset[:, None, None], np.full((3, *shape), np.nan)
    solution = solve_regions(surface(0.3, shape), unknown, given, resultant_newton=force_newton, tolerance=1e-11)
    np.testing.assert_allclose(solution.traction_pascal, traction, atol=1e-9)
    np.testing.assert_allclose(solution.shift_m, offset, rtol=1e-6)
