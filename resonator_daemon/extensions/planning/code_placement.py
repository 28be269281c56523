"""Assignment of codes to sites: sites with strong coupling get distant codes."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.base.arrays import Floats, Integers

NEIGHBOUR_FACTOR: Final = 1.5  # times the usual distance to the nearest site: on a square grid, diagonals too
DECAY_FACTOR: Final = 0.25  # of that distance: in it the coupling of two trapped modes falls by e, about
COUPLING_FACTOR: Final = 10.0  # times the coupling: a neighbour that far off takes 1 % of the response
NEIGHBOUR_STEPS: Final = 2  # at least, between the codes of neighbours
MISSING_COST: Final = 10.0  # of a pair without the steps it needs; the strongest coupling one step apart costs 1
TRIES_A_SITE: Final = 100
STARTS: Final = 4
SWAPS_AT_ONCE: Final = 64


def distances_m(positions_m: Floats) -> Floats:
    """(m, m) between sites at (m, 2); infinite from a site to itself."""
    distance: Floats = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
    np.fill_diagonal(distance, np.inf)
    return distance


def neighbours(distance_m: Floats) -> NDArray[np.bool_]:
    """(m, m): which sites are nearer than 1.5 times the median distance of a site to its nearest."""
    near: NDArray[np.bool_] = distance_m < NEIGHBOUR_FACTOR * _usual_m(distance_m)
    return near


def default_coupling(distance_m: Floats) -> Floats:
    """(m, m), in no unit: falls with distance as that of trapped modes about does."""
    coupling: Floats = np.exp(-distance_m / (DECAY_FACTOR * _usual_m(distance_m)))
    return coupling


def measured_coupling_hz(distance_m: Floats, at_m: tuple[float, float], hz: tuple[float, float]) -> Floats:
    """(m, m): the exponential through what was measured at two distances; half the splitting of two equal tones."""
    rate = math.log(hz[1] / hz[0]) / (at_m[1] - at_m[0])
    coupling: Floats = hz[0] * np.exp(rate * (distance_m - at_m[0]))
    return coupling


def needed_steps(distance_m: Floats, coupling_steps: Floats | None = None) -> Integers:
    """(m, m): how many steps of the ladder two sites must be apart: neighbours two, and all ten times their coupling.

    `coupling_steps` (m, m) is the coupling in steps of the ladder, where it is known.
    """
    steps = np.where(neighbours(distance_m), NEIGHBOUR_STEPS, 1)
    if coupling_steps is not None:
        steps = np.maximum(steps, np.ceil(COUPLING_FACTOR * coupling_steps)).astype(np.int64)
    return steps.astype(np.int64)


def missing(codes: Integers, steps: Integers) -> list[tuple[int, int]]:
    """Pairs of sites whose codes are fewer steps apart than they need, the first index below the second."""
    apart = np.abs(codes[:, None] - codes)
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(apart < steps, 1))]


def place_codes(coupling: Floats, code_count: int, steps: Integers, random: np.random.Generator) -> Integers:
    """Give each site one of the codes 1 to `code_count`, none twice.

    Swaps codes while that lessens the sum over pairs of (coupling / steps apart)^2, the share that a detuned neighbour
    takes of a site's response, and of what pairs lack of the steps that they need. `coupling` (m, m) is in any unit
    and 0 on its diagonal. ValueError where there are fewer codes than sites.
    """
    count = len(coupling)
    if code_count < count:
        raise ValueError(f"code_count {code_count} must be at least the number of sites, {count}")
    # Unused codes belong to sites that couple with none.
    weight = np.zeros((code_count, code_count))
    weight[:count, :count] = (coupling / (coupling.max() or 1.0)) ** 2
    need = np.ones((code_count, code_count))
    need[:count, :count] = steps
    best, least = np.arange(code_count), np.inf
    for _ in range(STARTS):
        codes = random.permutation(code_count)
        cost = _descend(codes, weight, need, count, random)
        if cost < least:
            best, least = codes, cost
    return best[:count] + 1


def _descend(codes: Integers, weight: Floats, need: Floats, count: int, random: np.random.Generator) -> float:
    """Swap in place; return the cost.

    Many swaps are judged at once, as most are of no use; behind the first that is made they are judged again.
    """
    first = random.integers(0, count, TRIES_A_SITE * count)
    second = random.integers(0, len(codes), len(first))
    swaps = np.stack([first, second], axis=1)[first != second]
    done, at_once = 0, 1
    while done < len(swaps):
        pairs = swaps[done : done + at_once]
        present = np.repeat(codes[None], len(pairs), axis=0)
        swapped = present.copy()
        np.put_along_axis(swapped, pairs, codes[pairs[:, ::-1]], axis=1)
        made = np.flatnonzero(_costs(swapped, weight, need, pairs) <= _costs(present, weight, need, pairs))
        if made.size:
            codes[:] = swapped[made[0]]
            done, at_once = done + int(made[0]) + 1, 1 + int(made[0])
        else:
            done, at_once = done + len(pairs), min(2 * at_once, SWAPS_AT_ONCE)
    every = np.arange(count)[:, None]
    return float(sum(_costs(np.repeat(codes[None], count, axis=0), weight, need, every).tolist()))


def _costs(codes: Integers, weight: Floats, need: Floats, sites: Integers) -> Floats:
    """(b,) of each row of codes (b, n): what some of its sites (b, k) cost."""
    apart = np.abs(np.take_along_axis(codes, sites, axis=1)[:, :, None] - codes[:, None])
    np.put_along_axis(apart, sites[:, :, None], codes.shape[1], axis=2)  # a site and itself
    lacks = np.maximum(need[sites] - apart, 0.0) / need[sites]
    costs = weight[sites] / (apart * apart) + MISSING_COST * lacks
    sums: Floats = costs.reshape(len(costs), -1).sum(axis=1)
    return sums


def _usual_m(distance_m: Floats) -> float:
    """Median distance of a site to its nearest; 1 m where there is but one site."""
    nearest = distance_m.min(axis=1)
    return float(np.median(nearest)) if np.isfinite(nearest).all() else 1.0
