"""Tests of the support: small maps drawn by hand."""

import numpy as np

from resonator_daemon.estimate.surface.contact_physics.support_search import blobs, load_support, swept


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
