"""Detection of loads in the wrong order: two steps whose exchange explains the residuals."""

import math
from itertools import combinations
from typing import Final

import numpy as np
from scipy.special import chdtri

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.forces.loading_solution import StepMeans

LOAD_STD: Final = (0.03, 0.01)  # relative to the load, to the largest load: scatter and hysteresis need no exchange
CHANCE: Final = 1e-3
GAP: Final = 13.8  # twice the log of odds of 1000 : 1


def swapped_steps(means: StepMeans, sensitivity: Floats) -> tuple[int, int] | None:
    """Two steps of one site whose loads were exchanged, of the site that shows it most; None where no site does.

    `sensitivity` (s, channels) is that of the plate file: of two loads, or of three at equal distances, the line goes
    through the exchanged ones as well, but with the sign of K reversed on all channels.
    """
    found: list[tuple[float, tuple[int, int]]] = []
    for site, expected in enumerate(sensitivity):
        rows = np.flatnonzero(means.site == site)
        shift, force = means.mean[rows], means.force[rows]
        if means.held[site]:
            continue
        gate = chdtri(max((len(rows) - 2) * shift.shape[1], 1), CHANCE)
        as_stated = _chi2(shift, force, expected)
        if as_stated <= gate:
            continue
        exchanged = [
            (_chi2(shift, _exchange(force, i, j), expected), (int(means.step[rows[i]]), int(means.step[rows[j]])))
            for i, j in combinations(range(len(rows)), 2)
            if force[i] != force[j]
        ]
        best, pair = min(exchanged)
        if best <= gate and as_stated - best > GAP:
            found.append((best - as_stated, pair))
    return min(found)[1] if found else None


def _exchange(force: Floats, i: int, j: int) -> Floats:
    result = force.copy()
    result[[i, j]] = force[[j, i]]
    return result


def _chi2(shift: Floats, force: Floats, expected: Floats) -> float:
    """Return chi2 of a line through shifts (k, channels) over loads (k,); infinite if no slope has the right sign."""
    weight = 1.0 / np.hypot(LOAD_STD[0] * force, LOAD_STD[1] * force.max()) ** 2
    off = force - weight @ force / weight.sum()
    slope = (weight * off) @ shift / ((weight * off) @ off)
    if (slope * expected < 0).all():
        return math.inf
    residual = shift - weight @ shift / weight.sum() - off[:, None] * slope
    return float((weight @ (residual / slope) ** 2).sum())
