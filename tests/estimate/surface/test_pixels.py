import numpy as np
import pytest

from resonator_daemon.estimate.surface.contact_physics.pixels import PixelLattice
from resonator_daemon.estimate.surface.contact_physics.support_search import blobs, load_support, swept


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


def drawn(*rows):
    return np.array([[int(c) if c.isdigit() else 0 for c in row] for row in rows], float) / 9.0


def test_noise_blobs_are_left_out_and_neighbours_come_in():
    pressure = drawn(
        "9.......",
        "9.....2.",  # above 15 %, below the 25 % of a contact
        "........",
        "..3.....",  # a single pixel
        ".......3",
        ".......3",
    )
    expected = np.zeros((6, 8), bool)
    expected[:3, :2] = True
    expected[3:, 6:] = True
    np.testing.assert_array_equal(load_support(pressure), expected)


def test_blobs_meet_at_corners():
    mask = drawn("9...", ".9..", "...9") > 0
    np.testing.assert_array_equal(blobs(mask), [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 2]])


def test_a_swept_mask_covers_the_way_and_ends_at_the_border():
    mask = drawn(".....", "99...", ".....", ".....") > 0
    there = drawn(".....", "9999.", ".....", ".....") > 0
    np.testing.assert_array_equal(swept(mask, np.array([0.0, 2.0])), there)
    slanting = drawn(".....", "99...", ".99..", "..99.") > 0
    np.testing.assert_array_equal(swept(mask, np.array([2.0, 2.0])), slanting)
    np.testing.assert_array_equal(swept(mask, np.array([-0.4, 0.2])), mask)
    np.testing.assert_array_equal(swept(mask, np.array([0.0, -1.0])), mask)
