"""Rectangular windows of a grid of pixels."""

import numpy as np

from resonator_daemon.arrays import Bools

Window = tuple[slice, slice]


def window_around(hit: Bools, margin: int = 0) -> Window:
    """Smallest window (y, x) that holds all pixels hit and a margin within the grid; all of it where none is hit."""

    def span(axis: int) -> slice:
        count = hit.shape[axis]
        at = np.flatnonzero(hit.any(axis=1 - axis))
        return slice(max(int(at[0]) - margin, 0), min(int(at[-1]) + 1 + margin, count)) if at.size else slice(0, count)

    return span(0), span(1)
