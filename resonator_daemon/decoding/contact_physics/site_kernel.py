"""Signals at sites under unit tractions on single square pixels, from the transfer matrices."""

from itertools import product

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.contact_physics.pixels import PixelLattice
from resonator_daemon.decoding.open_plane.prior_tables import Kernel, StationaryPrior
from resonator_daemon.elastic import HalfSpace

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_WHITE_DEPTHS = 1e-3  # correlation length over depth of a traction that is white to the signals
_NODES = 3  # of Gauss-Legendre along each side of a pixel
_SAME = 1e-6  # of the pitch: offsets this close are one
_CHUNK = 1 << 17


def site_kernel(half_space: HalfSpace, positions_m: Floats, depths_m: Floats, lattice: PixelLattice) -> Singles:
    """Signals of sites (n, 2) at depths (n,) under 1 Pa on each pixel: (3 components, pixels, 3 channels, n).

    Within 1e-4 of the largest signal for pixels up to half a depth wide.
    """
    centres_m = lattice.centres_m
    kernel = np.empty((3, len(centres_m), 3, len(positions_m)), np.float32)
    for depth_m in np.unique(depths_m):
        sites = np.flatnonzero(depths_m == depth_m)
        offsets = positions_m[sites] - centres_m[:, None]
        distinct, place = _distinct(offsets.reshape(-1, 2), lattice.pitch_m)
        green = _green(half_space, float(depth_m), float(np.hypot(*np.abs(distinct).max(axis=0)) + lattice.pitch_m))
        table = np.concatenate(
            [
                _pixel_mean(green, part, lattice.pitch_m)
                for part in np.array_split(distinct, len(distinct) // _CHUNK + 1)
            ]
        ).astype(np.float32)
        for component, channel in product(range(3), range(3)):
            kernel[component, :, channel, sites] = table[place, channel, component].reshape(offsets.shape[:2]).T
    return kernel


def _distinct(offsets_m: Floats, pitch_m: float) -> tuple[Floats, NDArray[np.intp]]:
    """Offsets without repetition (k, 2), and where each of (n, 2) is among them: on a grid few are left."""
    steps = np.rint(offsets_m / (_SAME * pitch_m)).astype(np.int64)
    steps -= steps.min(axis=0)
    _, first, place = np.unique(
        steps[:, 0] * (steps[:, 1].max() + 1) + steps[:, 1], return_index=True, return_inverse=True
    )
    return offsets_m[first], place


def _green(half_space: HalfSpace, depth_m: float, reach_m: float) -> Kernel:
    """Signals under a unit point force: the covariance of signals with a white traction of unit power."""
    length_m = _WHITE_DEPTHS * depth_m
    white = StationaryPrior(half_space, 1.0 / (np.sqrt(4.0 * np.pi) * length_m), length_m, 1.0)
    return white.kernel("sensor", depth_m, "traction", 0.0, reach_m)


def _pixel_mean(green: Kernel, offsets_m: Floats, pitch_m: float) -> Floats:
    """Integral of the point solution over the pixel, (k, 3, 3)."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    total = np.zeros((len(offsets_m), 3, 3))
    for (x, x_weight), (y, y_weight) in product(zip(nodes, weights, strict=True), repeat=2):
        total += x_weight * y_weight * green(offsets_m - np.array([x, y]) * pitch_m / 2.0)
    return total * pitch_m**2 / 4.0
