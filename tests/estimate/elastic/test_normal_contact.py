"""Contact without friction, and profiles of objects: closed forms, brute force, and counts of pixels."""

import numpy as np
import pytest
from scipy.optimize import nnls

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.elastic.contact import FrictionalContact, FrictionState, flat_punch, paraboloid
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance
from simulators.contact import pixel_tractions

SIDE_M = 12.8e-3
YOUNGS_PASCAL = 2e5

PROFILE_SHAPE, PITCH_M = (5, 8), 1e-3  # centres at y = -2 .. 2 mm, x = -3.5 .. 3.5 mm


def plane_strain_pascal(poisson_ratio: float) -> float:
    return YOUNGS_PASCAL / (1.0 - poisson_ratio**2)


def surface(shape: tuple[int, int], poisson_ratio: float = 0.3) -> SurfaceCompliance:
    return SurfaceCompliance(HalfSpace(YOUNGS_PASCAL, poisson_ratio), shape, SIDE_M / shape[1])


def press(
    compliance: SurfaceCompliance,
    profile: Floats,
    load_newton: float = np.nan,
    approach_m: float = np.nan,
    tolerance: float = 1e-8,
) -> FrictionState:
    contact = FrictionalContact(compliance, profile, 0.0, tolerance)
    return contact.step(contact.apart, load_newton=(0.0, 0.0, load_newton), shift_m=(np.nan, np.nan, approach_m))


def rough(shape: tuple[int, int], seed: int, rms_m: float = 1e-4) -> Floats:
    """White noise, the hardest of maps."""
    return np.random.default_rng(seed).normal(scale=rms_m, size=shape)


def with_rim(profile: Floats) -> Floats:
    profile = profile.copy()
    profile[[0, -1]] = profile[:, [0, -1]] = np.inf
    return profile


# Closed forms


@pytest.mark.parametrize(("count", "peak_error_max", "field_error_max"), [(32, 4e-3, 5e-2), (128, 2e-4, 1.2e-2)])
def test_hertz(count: int, peak_error_max: float, field_error_max: float):
    radius, curvature = 2e-3, 20e-3
    load = 4.0 * plane_strain_pascal(0.5) * radius**3 / (3.0 * curvature)
    shape, pitch = (count, count), SIDE_M / count
    found = press(surface(shape, 0.5), paraboloid(shape, pitch, curvature), load_newton=load)
    from_axis = pitch / np.sqrt(2.0)
    pressure = found.traction_pascal[2]
    peak = pressure.max() / np.sqrt(1.0 - (from_axis / radius) ** 2)
    assert peak == pytest.approx(1.5 * load / (np.pi * radius**2), rel=peak_error_max)
    expected = pixel_tractions((0.0, 0.0, load), (0.0, 0.0), radius / np.cbrt(load), 0.5, shape, pitch)[2]
    off = np.linalg.norm(pressure - expected) / np.linalg.norm(expected)
    assert off <= field_error_max
    assert found.shift_m[2] == pytest.approx(radius**2 / curvature, rel=peak_error_max)
    assert found.load_newton[2] == pytest.approx(load, rel=1e-12)
    assert found.slips.sum() * pitch**2 == pytest.approx(np.pi * radius**2, rel=0.6 / np.sqrt(count))
    assert found.residuals[-1] <= 1e-8


# Any shape


def dense_matrix(compliance: SurfaceCompliance) -> Floats:
    """Normal displacement of all pixels by 1 Pa on each, a column each."""
    count = compliance.shape[0] * compliance.shape[1]
    units = np.eye(count).reshape(count, *compliance.shape)
    return np.array([compliance.displacement_m(np.stack([0 * unit, 0 * unit, unit]))[2].ravel() for unit in units]).T


@pytest.mark.parametrize("shape", [(9, 7), (24, 26)])
@pytest.mark.parametrize("seed", range(3))
def test_noise_agrees_with_a_dense_active_set(shape: tuple[int, int], seed: int):
    """Non-negative least squares of the Cholesky factor, at the approach that the load came to."""
    profile = with_rim(rough(shape, seed))
    profile[2:4, 3] = np.inf
    compliance = surface(shape)
    matrix = dense_matrix(compliance)
    load = 0.2 * 10.0**seed
    found = press(compliance, profile, load_newton=load, tolerance=1e-10)
    there = np.isfinite(profile).ravel()
    factor = np.linalg.cholesky(matrix[np.ix_(there, there)]).T
    wanted = found.shift_m[2] - profile.ravel()[there]
    expected = np.zeros(there.size)
    expected[there], _ = nnls(factor, np.linalg.solve(factor.T, wanted), maxiter=10 * there.size)
    np.testing.assert_allclose(found.traction_pascal[2].ravel(), expected, atol=1e-7 * expected.max())
    np.testing.assert_array_equal(found.slips.ravel(), expected > 0.0)
    assert not found.traction_pascal[:2].any()
    np.testing.assert_array_equal(found.shift_m[:2], 0.0)
    assert expected.sum() * compliance.pitch_m**2 == pytest.approx(load, rel=1e-7)
    by_approach = press(compliance, profile, approach_m=found.shift_m[2], tolerance=1e-10)
    np.testing.assert_allclose(by_approach.traction_pascal[2].ravel(), expected, atol=1e-7 * expected.max())


def test_approach_that_touches_nothing():
    profile = paraboloid((30, 30), 1e-4, 0.01) + 1e-5
    found = press(SurfaceCompliance(HalfSpace(1e5, 0.5), (30, 30), 1e-4), profile, approach_m=1e-5)
    assert not found.traction_pascal.any()
    assert not found.displacement_m.any()


# Bad input

SHAPE = (30, 32)
BOWL = paraboloid(SHAPE, SIDE_M / 32, 0.02)


@pytest.mark.parametrize(
    ("profile", "arguments", "message"),
    [
        (BOWL.T, {"load_newton": 1.0}, r"profile_m has shape \(32, 30\), must be \(30, 32\)"),
        (np.where(BOWL < 1e-5, np.nan, BOWL), {"load_newton": 1.0}, "profile_m holds nan"),
        (np.full(SHAPE, np.inf), {"load_newton": 1.0}, "profile_m is inf everywhere"),
        (BOWL, {"load_newton": 1.0, "approach_m": 1e-4}, "in each direction one must be given"),
        (BOWL, {"load_newton": 0.0}, "load_newton is 0 along z, must be above 0"),
        (BOWL, {"load_newton": 10.0}, "touches the border of the height map, .* larger map"),
        (BOWL[0].max() + 0 * BOWL, {"load_newton": 1e-3}, "with a rim of inf"),
    ],
)
def test_bad_input_is_refused(profile: Floats, arguments: dict, message: str):
    with pytest.raises(ValueError, match=message):
        press(surface(SHAPE), profile, **arguments)


@pytest.mark.parametrize("side", range(4))
def test_contact_at_any_border_is_refused_until_there_is_a_rim(side: int):
    corner = np.array([(0.0, -6e-3), (0.0, 6e-3), (-6.4e-3, 0.0), (6.4e-3, 0.0)][side])
    profile = paraboloid(SHAPE, SIDE_M / 32, 0.02, tuple(corner))
    with pytest.raises(ValueError, match="touches the border"):
        press(surface(SHAPE), profile, load_newton=1e-2)
    assert press(surface(SHAPE), with_rim(profile), load_newton=1e-2).load_newton[2] == pytest.approx(1e-2)


def test_paraboloid_by_hand():
    found = paraboloid(PROFILE_SHAPE, PITCH_M, 0.02, (0.5e-3, -1e-3))
    assert found.shape == PROFILE_SHAPE
    assert found[1, 4] == pytest.approx(0.0, abs=1e-18)
    assert found[1, 0] == pytest.approx(4e-3**2 / 0.04)
    assert found[4, 7] == pytest.approx((3e-3**2 + 3e-3**2) / 0.04)


def test_flat_punch_fills_its_circle():
    found = flat_punch((400, 300), 1e-3, 0.1, (0.02, -0.05))
    assert set(np.unique(found)) == {0.0, np.inf}
    assert np.count_nonzero(found == 0.0) * 1e-6 == pytest.approx(np.pi * 0.1**2, rel=2e-3)
    rows, columns = np.nonzero(found == 0.0)
    assert rows.mean() == pytest.approx(199.5 - 50.0, abs=0.1)
    assert columns.mean() == pytest.approx(149.5 + 20.0, abs=0.1)
