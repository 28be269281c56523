"""Codes that can be mistaken for each other."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.forces.site_identification import FORCE_MIN_FRACTION


@dataclass(frozen=True, slots=True)
class CodeOverlap:
    """Two sites, indices into the plate's, whose codes some pair of forces within the range makes alike.

    On the channel where the least is missing their unloaded tones are `spacing_ppm` apart, and `needed_ppm` would do.
    """

    site: int
    other: int
    channel: int
    spacing_ppm: float
    needed_ppm: float


def code_overlaps(
    f0_hz: Floats, sensitivity: Floats, force_max_newton: float, *, common_shift: float, margin: float
) -> tuple[CodeOverlap, ...]:
    """Find the pairs of sites that can be mistaken for each other, the one that lacks most first.

    Sites i and j can be where forces F_i and F_j within the range and a common shift g exist with
    |ln(f0_i / f0_j) + K_i F_i - K_j F_j + g| <= margin on every channel: to first order in K F, for signed K.

    Parameters
    ----------
    f0_hz, sensitivity
        (m, channels); K in 1/N.
    common_shift
        Largest |g|, relative: what temperature, ageing and the pilot's residual may move all channels by unnoticed.
    margin
        Relative: what noise and the error of K may move a channel by. To distinguish sites at odds of 1000 : 1, about
        seven times the larger of the two sites' standard deviations at the largest force.
    """
    unloaded = np.log(f0_hz)
    ends = unloaded[..., None] + sensitivity[..., None] * force_max_newton * np.array([FORCE_MIN_FRACTION, 1.0])
    gap = _band_gaps(ends) - common_shift  # (channels, m, m)
    site, other = np.nonzero(np.triu((gap <= margin).all(axis=0), 1))
    alike = _distance(unloaded, sensitivity, force_max_newton, common_shift, site, other, margin) <= margin
    site, other = site[alike], other[alike]
    channel = gap[:, site, other].argmax(axis=0)
    missing = margin - gap[channel, site, other]
    spacing = np.abs(unloaded[site, channel] - unloaded[other, channel])
    columns = (site, other, channel, 1e6 * spacing, 1e6 * (spacing + missing))
    worst_first = np.argsort(-missing, kind="stable")
    return tuple(CodeOverlap(*pair) for pair in zip(*(c[worst_first].tolist() for c in columns), strict=True))


def _band_gaps(ends: Floats) -> Floats:
    """Gap between the bands of every two sites on each channel, (channels, m, m), negative where they overlap."""
    low, high = ends.min(axis=2).T, ends.max(axis=2).T
    gap: Floats = low[:, :, None] - high[:, None, :]
    return np.maximum(gap, gap.transpose(0, 2, 1))


def _distance(
    unloaded: Floats,
    sensitivity: Floats,
    force_max_newton: float,
    common_shift: float,
    site: NDArray[np.intp],
    other: NDArray[np.intp],
    margin: float,
) -> Floats:
    """Least over F_i, F_j and g of the largest mismatch over channels, for pairs (p,); exact up to `margin`.

    What the three can reach is a zonotope; its distance from the unloaded difference u in the maximum norm is the
    largest (|n u| - sum_k |n g_k|) / |n|_1, over the normals n of the zonotope's sum with a cube: those orthogonal to k
    generators g_k on k + 1 channels. Any n is a lower bound, so pairs that are found apart need no further ones.
    """
    middle, half = (0.5 * force_max_newton * (1.0 + sign * FORCE_MIN_FRACTION) for sign in (1, -1))
    offset = unloaded[site] - unloaded[other] + middle * (sensitivity[site] - sensitivity[other])
    generators = np.stack(
        [half * sensitivity[site], half * sensitivity[other], np.full(offset.shape, common_shift)], axis=1
    )
    distance = np.zeros(len(site))
    for chosen, channels in _choices(offset.shape[1]):
        open_pairs = np.flatnonzero(distance <= margin)
        if not open_pairs.size:
            break
        vectors = generators[open_pairs][:, :, channels]
        normal = _orthogonal(vectors[:, chosen])
        length = np.abs(normal).sum(axis=1)
        reach = np.abs(np.einsum("pkc,pc->pk", vectors, normal)).sum(axis=1)
        beyond = np.abs((offset[open_pairs][:, channels] * normal).sum(axis=1)) - reach
        bound = np.divide(beyond, length, out=np.zeros(len(length)), where=length > 0)
        distance[open_pairs] = np.maximum(distance[open_pairs], bound)
    return distance


def _choices(channel_count: int) -> Iterator[tuple[list[int], list[int]]]:
    """Which of the three generators a normal is orthogonal to, and on which channels, one more, it is not 0."""
    for count in range(min(3, channel_count - 1) + 1):
        for chosen in combinations(range(3), count):
            for channels in combinations(range(channel_count), count + 1):
                yield list(chosen), list(channels)


def _orthogonal(vectors: Floats) -> Floats:
    """Vector orthogonal to k vectors of k + 1 components, (p, k, k + 1) to (p, k + 1), by signed minors."""
    size = vectors.shape[2]
    # Of unit length, or the minors' products could underflow.
    norm = np.linalg.norm(vectors, axis=2, keepdims=True)
    unit = np.divide(vectors, norm, out=np.zeros_like(vectors), where=norm > 0)
    minors = [(-1) ** c * np.linalg.det(np.delete(unit, c, axis=2)) for c in range(size)]
    return np.stack(minors, axis=1)
