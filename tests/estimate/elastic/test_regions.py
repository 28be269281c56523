"""Known regions: rigid punches of closed form, dense algebra, reciprocity."""

import numpy as np
import pytest
from dense_surface import dense_compliance

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance
from resonator_daemon.estimate.elastic.regions import RegionSolution, solve_regions

MU, PITCH_M = 7e4, 4e-4
NU = [-0.5, 0.0, 0.3, 0.5]


def surface(nu: float, shape: tuple[int, int], *, periodic: bool = False) -> SurfaceCompliance:
    return SurfaceCompliance(HalfSpace(2 * MU * (1 + nu), nu), shape, PITCH_M, periodic)


class Punch:
    """A rigid disc of 20 pixels' radius; tractions 0 where no displacement is known."""

    def __init__(self) -> None:
        axis = (np.arange(48) - 23.5) * PITCH_M
        self.x, self.y = np.meshgrid(axis, axis)
        self.radius_m = 20 * PITCH_M
        self.under = np.hypot(self.x, self.y) <= self.radius_m

    def move(self, nu: float, held: str, displacement: list[Floats | float]) -> RegionSolution:
        known = np.array([self.under & (axis in held) for axis in "xyz"])
        moved = np.array([np.broadcast_to(u, self.x.shape) for u in displacement])
        return solve_regions(surface(nu, self.x.shape), np.where(known, np.nan, 0.0), np.where(known, moved, np.nan))

    def force(self, solution: RegionSolution) -> Floats:
        return solution.traction_pascal.sum(axis=(1, 2)) * PITCH_M**2


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
    beside = (r > 1.1 * A) & (r < 1.3 * A)
    np.testing.assert_allclose(solution.displacement_m[2][beside], 2e-5 / np.pi * np.arcsin(A / r[beside]), rtol=0.011)
    assert not solution.traction_pascal[:2].any()
    assert not solution.shift_m.any()


@pytest.mark.parametrize("nu", NU)
def test_bonded_flat_punch(nu: float):
    """The tangential tractions that bonding takes stiffen it by up to a fifth (nu = -0.5), not at nu = 1/2."""
    solution = PUNCH.move(nu, "xyz", [0, 0, 1e-5])
    assert PUNCH.force(solution) == pytest.approx([0, 0, bonded_stiffness(nu) * 1e-5], rel=6e-3, abs=1e-9)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("nu", NU)
def test_recovers_a_state_from_either_half_of_it(nu: float, periodic: bool):
    """Made by a dense matrix that shares nothing with the code; then the known and the unknown change places."""
    rng = np.random.default_rng(11)
    shape = (9, 12)
    matrix = dense_compliance(shape, nu, MU, PITCH_M, periodic=periodic)
    traction = rng.normal(size=(3, *shape))
    displacement = (matrix @ traction.ravel()).reshape(3, *shape)
    mask = rng.random((3, *shape)) < 0.5
    for region in (mask, ~mask):
        known = np.where(region, np.nan, traction), np.where(region, displacement, np.nan)
        solution = solve_regions(surface(nu, shape, periodic=periodic), *known, tolerance=1e-11)
        np.testing.assert_allclose(solution.traction_pascal, traction, atol=1e-9)
        np.testing.assert_allclose(solution.displacement_m, displacement, atol=1e-10 * np.abs(displacement).max())


def test_displacements_known_all_over_a_periodic_surface_need_a_resultant():
    rng = np.random.default_rng(4)
    shape = (8, 9)
    matrix = dense_compliance(shape, 0.3, MU, PITCH_M, periodic=True)
    traction = rng.normal(size=(3, *shape))
    displacement = (matrix @ traction.ravel()).reshape(3, *shape)
    offset = np.array([3e-9, -1e-9, 2e-9])
    given = displacement - offset[:, None, None]
    unknown = np.full((3, *shape), np.nan)
    compliance = surface(0.3, shape, periodic=True)
    solution = solve_regions(
        compliance, unknown, given, resultant_newton=traction.sum(axis=(1, 2)) * PITCH_M**2, tolerance=1e-11
    )
    np.testing.assert_allclose(solution.traction_pascal, traction, atol=1e-9)
    np.testing.assert_allclose(solution.shift_m, offset, rtol=1e-6)
    with pytest.raises(ValueError, match=r"u_y on the whole of a periodic surface, which leaves its mean f_y open"):
        solve_regions(compliance, unknown, given, resultant_newton=[0.0, np.nan, 0.0])
