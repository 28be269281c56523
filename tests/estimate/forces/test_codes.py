import numpy as np
import pytest
from scipy.optimize import linprog

from resonator_daemon.estimate.forces.codes import code_overlaps

LARGEST = 10.0


def least_mismatch_ppm(unloaded, sensitivity, common_shift):
    """Least over both forces and the common shift of the largest mismatch, by a linear program in ppm and newtons."""
    difference, (a, b) = unloaded[0] - unloaded[1], sensitivity
    channels = len(difference)
    rows = np.column_stack([a, -b, np.full(channels, 1e-6), np.zeros(channels)]) * 1e6
    above, below = rows.copy(), -rows
    above[:, 3] = below[:, 3] = -1
    forces = [(-0.02 * LARGEST, LARGEST)] * 2
    return linprog(
        [0, 0, 0, 1],
        A_ub=np.vstack([above, below]),
        b_ub=np.concatenate([-difference, difference]) * 1e6,
        bounds=[*forces, (-common_shift * 1e6, common_shift * 1e6), (0, None)],
        method="highs",
    ).fun


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("kind", ["any sign", "one sign", "channels alike", "one of a sign"])
@pytest.mark.parametrize("common_shift", [0.0, 3e-6, 2e-5])
def test_two_codes_overlap_exactly_where_a_linear_program_says_so(channels, kind, common_shift):
    rng = np.random.default_rng([channels, len(kind)])
    for _ in range(15):
        unloaded = rng.uniform(-1, 1, (2, channels)) * rng.choice([20e-6, 80e-6])
        sensitivity = rng.uniform(-8e-6, 8e-6, (2, channels))
        if kind == "one sign":
            sensitivity = -np.abs(sensitivity)
        elif kind == "channels alike":
            sensitivity = np.repeat(sensitivity[:, :1], channels, axis=1)
        elif kind == "one of a sign":
            sensitivity = np.abs(sensitivity) * np.array([[1], [-1]])
        least = least_mismatch_ppm(unloaded, sensitivity, common_shift)
        f0_hz = 10e6 * np.exp(unloaded)
        for margin_ppm in (least - 0.01, least + 0.01):
            if margin_ppm >= 0:
                found = code_overlaps(f0_hz, sensitivity, LARGEST, common_shift=common_shift, margin=margin_ppm * 1e-6)
                assert bool(found) == (margin_ppm > least)


def ladder(step, sites=16, *, factor=1.0):
    f0_hz = 10e6 * np.exp(-step * np.arange(sites))[:, None] * np.ones(4)
    return f0_hz, np.full((sites, 4), -6.3e-6 * factor)


def test_the_pair_that_lacks_most_comes_first():
    f0_hz, sensitivity = ladder(300e-6)
    f0_hz[9] = f0_hz[8] * (1 - 50e-6)
    f0_hz[4] = f0_hz[3] * (1 - 20e-6)
    found = code_overlaps(f0_hz, sensitivity, LARGEST, common_shift=5e-6, margin=5e-6)
    assert [(pair.site, pair.other) for pair in found] == [(3, 4), (8, 9)]
    assert [pair.spacing_ppm for pair in found] == pytest.approx([20, 50], abs=0.01)


def test_what_is_missing_is_told_of_the_channel_where_least_is():
    f0_hz, sensitivity = ladder(0.0, 2)
    f0_hz[1] *= np.exp([-10e-6, 20e-6, -50e-6, 30e-6])
    (pair,) = code_overlaps(f0_hz, sensitivity, LARGEST, common_shift=5e-6, margin=60e-6)
    assert pair.channel == 2
    assert (pair.spacing_ppm, pair.needed_ppm) == pytest.approx((50, 63 * 1.02 + 65), rel=1e-6)
