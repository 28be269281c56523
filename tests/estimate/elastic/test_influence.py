"""Surface influence coefficients against point loads integrated by quadrature, and Love's value."""

import itertools

import numpy as np
import pytest

from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.influence import SurfaceCompliance

E = 2.0e5
PITCH = 4e-4


def test_middle_of_a_loaded_square_sinks_as_love_found():
    """u_z = 8 (1 - nu^2) ln(1 + sqrt 2) p b / (pi E) in the middle of a square of side 2 b, whole or in pixels."""
    for count, nu in itertools.product((1, 5), (0.0, 0.3, 0.5)):
        compliance = SurfaceCompliance(HalfSpace(E, nu), (count, count), PITCH)
        load = np.zeros((3, count, count))
        load[2] = 70.0
        found = compliance.displacement_m(load)[:, count // 2, count // 2]
        expected = 8 * (1 - nu**2) * np.log(1 + np.sqrt(2)) * 70.0 * (count * PITCH / 2) / (np.pi * E)
        np.testing.assert_allclose(found, [0.0, 0.0, expected], rtol=1e-12, atol=1e-15 * expected)
    assert SurfaceCompliance(HalfSpace(E, 0.3), (4, 4), PITCH).of_own_load == pytest.approx(
        8 * (1 - 0.3**2) * np.log(1 + np.sqrt(2)) * (PITCH / 2) / (np.pi * E), rel=1e-12
    )


@pytest.mark.parametrize("window", [(5, 6), (14, 13), (16, 15)])
def test_a_window_has_the_coefficients_of_the_whole(window: tuple[int, int]):
    rng = np.random.default_rng(2)
    compliance = SurfaceCompliance(HalfSpace(E, 0.3), (16, 15), PITCH)
    ny, nx = window
    load = np.zeros((3, 16, 15))
    load[:, 16 - ny :, 15 - nx :] = rng.normal(size=(3, ny, nx))
    whole = compliance.displacement_m(load)[:, 16 - ny :, 15 - nx :]
    rows: tuple[int, ...] = (2, 0)
    part = compliance.convolution(rows, (0, 1, 2), window)(load[:, 16 - ny :, 15 - nx :])
    np.testing.assert_allclose(part, whole[list(rows)], atol=1e-13 * np.abs(whole).max())
