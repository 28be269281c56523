"""Partial-slip contact: tractions against sampling and Coulomb's law, and tabulated signals against exact ones."""

import math

import numpy as np
import pytest

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import load_plate
from simulators.contact import hertz_parts, pixel_tractions, pressed_signals, punch_parts
from simulators.pressed_surface import PressedSurface

RADIUS, FRICTION, CENTRE = 2.5e-3, 0.5, (0.3e-3, -0.7e-3)
SHAPE, PITCH = (32, 32), 4e-4


def sampled_traction(force: Floats, x: Floats, y: Floats) -> Floats:
    """Cattaneo and Mindlin's tractions (3, ...) at points of the surface, written out."""
    shear = math.hypot(force[0], force[1])
    a = RADIUS * force[2] ** (1 / 3)
    c = a * (1 - shear / (FRICTION * force[2])) ** (1 / 3)
    r2 = (x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2
    peak = 3 * force[2] / (2 * math.pi * a**2)
    pressure = peak * np.sqrt(np.maximum(1 - r2 / a**2, 0))
    stuck = peak * c / a * np.sqrt(np.maximum(1 - r2 / c**2, 0))
    tangential = FRICTION * (pressure - stuck) / shear
    return np.stack([tangential * force[0], tangential * force[1], pressure])


def midpoints(count: int, pitch: float) -> tuple[Floats, Floats]:
    line = (np.arange(count) - (count - 1) / 2) * pitch
    x, y = np.meshgrid(line, line)
    return x, y


@pytest.mark.parametrize("force", [[0.2, 0.1, 0.0], [0.2, 0.1, -1.0], [0.0, 0.0, 0.0]])
def test_nothing_acts_without_pressing(force: list[float]) -> None:
    radii, forces = hertz_parts(force, RADIUS, FRICTION)
    assert not radii.any()
    assert not forces.any()
    assert not pixel_tractions(force, CENTRE, RADIUS, FRICTION, SHAPE, PITCH).any()


@pytest.mark.parametrize("normal", [1e-9, 1e-3, 0.1, 1.0, 3.0])
@pytest.mark.parametrize("share", [0.0, 1e-6, 0.5, 0.999999, 1.0])
def test_pixels_sum_to_the_force(normal: float, share: float) -> None:
    shear = share * FRICTION * normal
    force = np.array([-0.28 * shear, 0.96 * shear, normal])
    traction = pixel_tractions(force, CENTRE, RADIUS, FRICTION, SHAPE, PITCH)
    np.testing.assert_allclose(traction.sum(axis=(1, 2)) * PITCH**2, force, rtol=0, atol=1e-11 * normal)


def test_pixels_average_the_traction() -> None:
    force = np.array([0.3, -0.1, 1.0])
    fine = 40
    points = sampled_traction(force, *midpoints(SHAPE[0] * fine, PITCH / fine))
    expected = points.reshape(3, SHAPE[0], fine, SHAPE[1], fine).mean(axis=(2, 4))
    found = pixel_tractions(force, CENTRE, RADIUS, FRICTION, SHAPE, PITCH)
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


RADIUS_MAX_M = 8e-3
OF_PEAK = 1e-4  # measured: 1.1e-5; two decades below the gain error of a tone


@pytest.mark.parametrize(("name", "nu"), [("skin32", 0.5), ("fingertip400", 0.5), ("fingertip400", 0.3)])
def test_random_presses_are_as_by_the_closed_form(name: str, nu: float) -> None:
    plate, random = load_plate(name), np.random.default_rng(5)
    sites_m, skin = plate.site_positions_m, plate.skin
    assert skin
    low_m, high_m = plate.outline_m.min(axis=0), plate.outline_m.max(axis=0)
    surface = PressedSurface(
        sites_m, skin.depth_m, skin.youngs_modulus_pascal, nu, float(np.hypot(*(high_m - low_m))), RADIUS_MAX_M
    )
    worst = 0.0
    for _ in range(60):
        x, y = random.uniform(low_m, high_m).tolist()
        friction, normal = random.uniform(0.05, 1.5), random.uniform(0.01, 5.0)
        radius_m = random.uniform(1e-4, RADIUS_MAX_M)
        angle, share = random.uniform(0.0, 2.0 * np.pi), random.choice([0.0, 1.0, random.uniform()])
        force = np.array([np.cos(angle), np.sin(angle), 0.0]) * share * friction * normal + [0.0, 0.0, normal]
        of_1_newton_m = radius_m / normal ** (1 / 3)
        (found,) = surface.signals((x, y), *hertz_parts([force], of_1_newton_m, friction))
        exact = pressed_signals(
            sites_m, skin.depth_m, skin.youngs_modulus_pascal, nu, (x, y), of_1_newton_m, friction, force
        )
        peak = np.abs(exact).max(axis=1, keepdims=True)
        worst = max(worst, (np.abs(found - exact) / peak).max())
    assert worst < OF_PEAK


def test_what_is_beyond_the_table_is_an_error() -> None:
    surface = PressedSurface([(0.0, 0.0), (1e-3, 0.0)], 1e-3, 2e5, 0.5, 3e-3, 2e-3)
    with pytest.raises(ValueError, match="radius"):
        surface.signals((0.0, 0.0), *hertz_parts([(0.0, 0.0, 1.0)], 2.1e-3, 0.5))
    with pytest.raises(ValueError, match="site"):
        surface.signals((-2.1e-3, 0.0), *hertz_parts([(0.0, 0.0, 1.0)], 1e-3, 0.5))


@pytest.mark.parametrize("adhesion", [None, 0.0, 0.3])
def test_pressure_below_punch_and_adhesive_ball_has_its_closed_form(adhesion: float | None) -> None:
    nu, depth, a = 0.4, 1e-3, 2e-3
    punch = (1.0, 1.0) if adhesion is None else (0.0, -adhesion)
    places_m = [(0.0, 0.0), (30e-3, 0.0)]
    surface = PressedSurface(places_m, depth, 2e5, nu, 40e-3, 8e-3, punch=punch)
    load = np.array([[a, 0.0]]), np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]])
    below, far = surface.signals((0.0, 0.0), *load)[0, 0]
    ball, flat = 3 / a**2 * (1 - depth / a * math.atan(a / depth)), 1 / (a**2 + depth**2)
    expected = flat if adhesion is None else (1 + adhesion) * ball - adhesion * flat
    assert below == pytest.approx(-(1 + nu) / (3 * math.pi) * expected, rel=1e-5)
    point = -(1 + nu) / (3 * math.pi) * depth / math.hypot(30e-3, depth) ** 3
    assert far == pytest.approx(point, rel=0.01)  # all of the load


def test_a_punch_sticks_everywhere_until_it_slides() -> None:
    radii, forces = punch_parts([[0.3, 0.4, 2.0], [0.6, 0.8, 2.0], [0.9, 1.2, 2.0], [0.1, 0.0, 0.0]], RADIUS, FRICTION)
    a = RADIUS * 2 ** (1 / 3)
    assert radii == pytest.approx(np.array([[a, a], [a, 0.0], [a, 0.0], [0.0, 0.0]]))
    assert forces.sum(axis=1) == pytest.approx(np.array([[0.3, 0.4, 2.0], [0.6, 0.8, 2.0], [0.6, 0.8, 2.0], [0, 0, 0]]))
