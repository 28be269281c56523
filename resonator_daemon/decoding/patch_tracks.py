"""Patches over time: which one of a frame is which of the frame before."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.patches import Patch

_LEAST_REACH_M = 1e-3  # that a patch may move between frames; else its radius


@dataclass
class _Track:
    centroid_m: Floats
    reach_m: float
    missed: int = 0


class PatchTracker:
    """Gives each patch an id that it keeps while it moves by less than its radius, or 1 mm, from frame to frame.

    Parameters
    ----------
    patience
        Frames for which a patch may be missing and still keep its id, at least 0.

    Attributes
    ----------
    last_id
        The largest that was given so far; the next one follows it.
    """

    def __init__(self, patience: int = 2) -> None:
        if patience < 0:
            raise ValueError(f"patience is {patience}, must be at least 0")
        self._patience = patience
        self._tracks: dict[int, _Track] = {}
        self.last_id = 0

    @property
    def ids(self) -> frozenset[int]:
        """Of all patches that are followed, those that are missing for the moment among them."""
        return frozenset(self._tracks)

    def clear(self) -> None:
        """Follow none of the patches before any longer."""
        self._tracks = {}

    def update(self, patches: Sequence[Patch]) -> dict[int, Patch]:
        """Patches of a frame by id, ids counting up from 1; matched so that their moves are least in total."""
        ids = list(self._tracks)
        found: dict[int, Patch] = {}
        left = list(patches)
        if ids and patches:
            moves = np.array(
                [[np.hypot(*(patch.centroid_m - self._tracks[i].centroid_m)) for patch in patches] for i in ids]
            )
            reach = np.array([self._tracks[i].reach_m for i in ids])[:, None]
            # A move beyond reach costs as much as all others together, so that it never displaces one within.
            cost = np.where(moves <= reach, moves, reach.max() * (1 + moves.size))
            for row, column in zip(*linear_sum_assignment(cost), strict=True):
                if moves[row, column] <= reach[row, 0]:
                    found[ids[row]] = patches[int(column)]
            left = [patch for patch in patches if not any(patch is taken for taken in found.values())]
        for patch in left:
            self.last_id += 1
            found[self.last_id] = patch
        for i in ids:
            self._tracks[i].missed += 1
        for i, patch in found.items():
            self._tracks[i] = _Track(patch.centroid_m, max(patch.radius_m, _LEAST_REACH_M))
        self._tracks = {i: track for i, track in self._tracks.items() if track.missed <= self._patience}
        return found
