"""Fields of sampled loads against closed forms, an integral over polar frequencies, and each other."""

import math

import numpy as np
import pytest
from scipy.special import erf

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.fields import SurfaceFields
from resonator_daemon.estimate.elastic.half_space import HalfSpace, Input, Output
from simulators.contact import pixel_tractions
from simulators.half_space_fields import hertz_fields

E = 2.0e5
A = 2e-3  # radius of the Hertz distributions


def centres(count: int, pitch: float) -> Floats:
    return (np.arange(count) - (count - 1) / 2) * pitch


def hertz_signals(
    shape: tuple[int, int], pitch: float, depth: float, nu: float, force: Floats, centre: tuple[float, float]
) -> Floats:
    """Closed form of the "sensor" rows under a Hertz distribution of `force`, shape (3, ny, nx)."""
    x, y = np.meshgrid(centres(shape[1], pitch) - centre[0], centres(shape[0], pitch) - centre[1])
    fields = hertz_fields(np.stack([x.ravel(), y.ravel()], axis=1), depth, [A], E, nu)[0]
    signals = np.tensordot(force, fields, 1) * np.array([[1.5 / E], [1.0], [1.0]])
    return signals.reshape(3, *shape)


def relative_errors(found: Floats, expected: Floats) -> Floats:
    return np.linalg.norm(found - expected, axis=(-2, -1)) / np.linalg.norm(expected, axis=(-2, -1))


# --- Hertz


def hertz_errors(nu: float, count: int = 128, side: float = 12.8e-3) -> Floats:
    """Errors of p_n, eps_xz, eps_yz 1 mm below a Hertz pressure with equal shear along x."""
    shape, pitch, force = (count, count), side / count, np.array([1.0, 0.0, 1.0])
    load = pixel_tractions(force, (0.0, 0.0), A, 1.0, shape, pitch)
    found = SurfaceFields(HalfSpace(E, nu), shape, pitch, "sensor", 1e-3)(load)
    return relative_errors(found, hertz_signals(shape, pitch, 1e-3, nu, force, (0.0, 0.0)))


@pytest.mark.parametrize("nu", [0.3, 0.5])
def test_hertz_load_as_stated(nu: float):
    np.testing.assert_array_less(hertz_errors(nu), 5e-6)
    np.testing.assert_array_less(hertz_errors(nu, 32), 1.3e-3)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
def test_surface_displacement_of_a_hertz_load(nu: float):
    """Johnson, Contact Mechanics, eqs (3.41), (3.42) under the normal load and beside it; (3.91) under the shear."""
    count, pitch = 80, 1e-4
    x, y = np.meshgrid(centres(count, pitch), centres(count, pitch))
    r = np.hypot(x, y)
    inside = r < A
    p0, mu = 1.5 / (math.pi * A**2), E / (2 * (1 + nu))
    field = SurfaceFields(HalfSpace(E, nu), (count, count), pitch, "displacement", 0.0)

    ratio = np.minimum(A / r, 1.0)
    under = np.pi / 2 * (2 * A**2 - r**2)
    beside = (2 * A**2 - r**2) * np.arcsin(ratio) + r**2 * ratio * np.sqrt(1 - ratio**2)
    normal = (1 - nu**2) * p0 / (2 * E * A) * np.where(inside, under, beside)
    hollow = np.where(inside, 1 - np.maximum(1 - (r / A) ** 2, 0.0) ** 1.5, 1.0)
    radial = -(1 - 2 * nu) * (1 + nu) / (3 * E) * A**2 / r * p0 * hollow
    found = field(pixel_tractions((0.0, 0.0, 1.0), (0.0, 0.0), A, 0.0, (count, count), pitch))
    expected = np.stack([radial * x / r, radial * y / r, normal])
    assert np.abs(found - expected).max() < 6e-4 * normal.max()

    shear = np.pi * p0 / (32 * mu * A)
    along = shear * (4 * (2 - nu) * A**2 - (4 - 3 * nu) * x**2 - (4 - nu) * y**2)
    across = shear * 2 * nu * x * y
    sliding = pixel_tractions((1.0, 0.0, 1.0), (0.0, 0.0), A, 1.0, (count, count), pitch)
    sliding[2] = 0.0
    found = field(sliding)
    error = np.abs(found[:2] - np.stack([along, across]))[:, inside].max()
    assert error < 6e-4 * along.max()
    assert np.abs(found[2] + radial * x / r).max() < 6e-4 * along.max()  # reciprocal to the pull of the normal load


# --- a smooth load, whose samples miss nothing: all matrices

PITCH = 4e-4
SPREAD = 2.4 * PITCH
SHAPE = (36, 42)
CENTRE = np.array([0.7 * PITCH, -0.4 * PITCH])


def gaussian_samples(input: Input) -> Floats:
    """A Gaussian bell of unit height: means over the pixels for a traction, values for a displacement."""
    axes = []
    for count, centre in zip(SHAPE, CENTRE[::-1], strict=True):
        place = centres(count, PITCH) - centre
        if input == "displacement":
            axes.append(np.exp(-((place / SPREAD) ** 2) / 2))
        else:
            upto = [erf((place + side * PITCH / 2) / (math.sqrt(2) * SPREAD)) for side in (-1, 1)]
            axes.append(math.sqrt(math.pi / 2) * SPREAD / PITCH * (upto[1] - upto[0]))
    return np.outer(*axes)


def gaussian_fields(output: Output, input: Input, nu: float, depth: float, places: Floats) -> Floats:
    """Fields (n, rows, 3) of a bell at the origin, by the inverse transform in polar form: no grid, no period."""
    nodes, weights = np.polynomial.legendre.leggauss(120)
    w = 9.0 / SPREAD * (1 + nodes) / 2
    angle = np.arange(96) * (2 * np.pi / 96)
    wx, wy = np.outer(w, np.cos(angle)), np.outer(w, np.sin(angle))
    bell = 2 * np.pi * SPREAD**2 * np.exp(-(SPREAD**2) * w**2 / 2)
    area = (9.0 / SPREAD * weights / 2 * w * bell)[:, None] * (2 * np.pi / 96) / (4 * np.pi**2)
    matrix = HalfSpace(E, nu).transfer_matrix(output, input, wx, wy, depth)
    phases = np.array([np.exp(1j * (wx * x + wy * y)) for x, y in places]) * area
    return np.tensordot(phases, matrix, 2).real


@pytest.mark.parametrize("nu", [0.3, 0.5])
@pytest.mark.parametrize(
    ("output", "input"),
    [
        *((output, "traction") for output in ("displacement", "strain", "stress", "p_n", "sensor")),
        *((output, "displacement") for output in ("displacement", "strain", "stress", "p_n", "sensor", "traction")),
    ],
)
def test_gaussian_load_agrees_with_the_integral_over_the_plane(output: Output, input: Input, nu: float):
    sites = [(3, 5), (17, 21), (18, 20), (14, 25), (22, 17), (35, 41)]
    places = np.array([[centres(SHAPE[1], PITCH)[i], centres(SHAPE[0], PITCH)[j]] for j, i in sites]) - CENTRE
    depths = [0.0] if output == "traction" else [0.0, 2.1e-4, 1e-3]
    loads = np.zeros((3, 3, *SHAPE))
    loads[range(3), range(3)] = gaussian_samples(input)
    found = SurfaceFields(HalfSpace(E, nu), SHAPE, PITCH, output, depths, input=input)(loads)
    for number, depth in enumerate(depths):
        expected = gaussian_fields(output, input, nu, depth, places)
        at_sites = np.stack([found[:, number, :, j, i].T for j, i in sites])
        assert np.abs(at_sites - expected).max() < 1e-10 * np.abs(expected).max(), depth


def test_surface_values_are_the_input_at_every_lag_of_a_large_grid():
    """Noise holds all frequencies of the band; what an untrue node or weight adds would show."""
    moved = np.random.default_rng(2).standard_normal((3, 150, 220))
    found = SurfaceFields(HalfSpace(E, 0.3), (150, 220), PITCH, "displacement", 0.0, input="displacement")(moved)
    np.testing.assert_allclose(found, moved, atol=1e-10)


# --- no wrap, batches


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (7, 1), (7, 10), (13, 8)])
def test_a_wider_grid_changes_nothing(shape: tuple[int, int]):
    """Every lag of the small grid, to its opposite corners, holds what the middle of a large one holds."""
    rng = np.random.default_rng(5)
    ny, nx = shape
    small = rng.standard_normal((3, ny, nx))
    large = np.zeros((3, ny + 9, nx + 20))
    large[:, 4 : 4 + ny, 11 : 11 + nx] = small
    for output in ("displacement", "strain"):
        found = SurfaceFields(HalfSpace(E, 0.3), shape, PITCH, output, 3e-4)(small)
        wide = SurfaceFields(HalfSpace(E, 0.3), large.shape[1:], PITCH, output, 3e-4)(large)
        expected = wide[:, 4 : 4 + ny, 11 : 11 + nx]
        assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


def test_loads_of_a_batch_do_not_depend_on_each_other():
    loads = np.random.default_rng(1).standard_normal((2, 4, 3, 9, 12))
    field = SurfaceFields(HalfSpace(E, 0.3), (9, 12), PITCH, "p_n", [1e-3, 0.0])
    together = field(loads)
    assert together.shape == (2, 4, 2, 1, 9, 12)
    np.testing.assert_array_equal(together[1, 2], field(loads[1, 2]))
    shallow = SurfaceFields(HalfSpace(E, 0.3), (9, 12), PITCH, "p_n", 0.0)
    np.testing.assert_array_equal(together[:, :, 1], shallow(loads))
    np.testing.assert_array_equal(field(np.ones((3, 9, 12), int)), field(np.ones((3, 9, 12))))
