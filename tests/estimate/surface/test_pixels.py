"""The pixel lattice over other grids."""

import numpy as np
import pytest

from resonator_daemon.estimate.surface.contact_physics.pixels import PixelLattice


def grid(count_y, count_x, pitch_m):
    y, x = np.divmod(np.arange(count_y * count_x), count_x)
    return np.column_stack([x, y]) * pitch_m


@pytest.mark.parametrize("pitch_m", [1e-4, 1e-3])
def test_other_grids_get_pixels_of_two_fifths_of_the_depth(pitch_m):
    lattice = PixelLattice.over(grid(9, 9, pitch_m), 1e-3)
    assert lattice.pitch_m == pytest.approx(4e-4)
    low_m, high_m = lattice.centres_m.min(axis=0), lattice.centres_m.max(axis=0)
    np.testing.assert_allclose(low_m + high_m, 8 * pitch_m, atol=1e-12)
    assert (low_m <= -3.2e-3 + 1e-12).all()
