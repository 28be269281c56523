"""Patches over time: which one of a frame is which of the frame before."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from resonator_daemon.estimate.surface.patches import Patch

_LEAST_REACH_M = 1e-3  # that a patch may move between frames; else its radius


@dataclass
class _Track:
    centroid_m: list[float]
    reach_m: float
    missed: int = 0


class PatchTracker:
    """Tracker of patches, whose ids they keep while they move by less than their radius, or 1 mm, a frame.

    Parameters
    ----------
    patience
        Frames for which a patch may be missing and still keep its id, at least 0.

    Attributes
    ----------
    patience
    last_id
        The largest that was given so far; the next one follows it.
    """

    def __init__(self, patience: int = 2) -> None:
        if patience < 0:
            raise ValueError(f"patience is {patience}, must be at least 0")
        self.patience = patience
        self._tracks: dict[int, _Track] = {}
        self.last_id = 0

    @property
    def ids(self) -> frozenset[int]:
        """Of all patches that are followed, those that are missing for the moment among them."""
        return frozenset(self._tracks)

    def clear(self) -> None:
        """Discard all tracks."""
        self._tracks = {}

    def update(self, patches: Sequence[Patch]) -> dict[int, Patch]:
        """Return the patches of a frame by id, from 1; they are matched so that their moves are least in total."""
        ids = list(self._tracks)
        centroids_m = [patch.centroid_m.tolist() for patch in patches]
        moves_m = [[math.dist(self._tracks[i].centroid_m, centroid_m) for centroid_m in centroids_m] for i in ids]
        matched = _match(moves_m, [self._tracks[i].reach_m for i in ids]) if ids and patches else {}
        id_of = {column: ids[row] for row, column in matched.items()}
        for column in range(len(patches)):
            if column not in id_of:
                self.last_id += 1
                id_of[column] = self.last_id
        for track in self._tracks.values():
            track.missed += 1
        for column, i in id_of.items():
            self._tracks[i] = _Track(centroids_m[column], max(patches[column].radius_m, _LEAST_REACH_M))
        self._tracks = {i: track for i, track in self._tracks.items() if track.missed <= self.patience}
        return {i: patches[column] for column, i in id_of.items()}


def _match(moves_m: list[list[float]], reach_m: list[float]) -> dict[int, int]:
    """Assign columns to rows so that the moves within each row's reach are least in total."""
    if len(moves_m) == len(moves_m[0]) == 1:
        pairs = [(0, 0)]
    else:
        moves, reach = np.array(moves_m), np.array(reach_m)[:, None]
        # A move beyond reach costs as much as all others together, so that it never displaces one within.
        cost = np.where(moves <= reach, moves, reach.max() * (1 + moves.size))
        pairs = [(int(row), int(column)) for row, column in zip(*linear_sum_assignment(cost), strict=True)]
    return {row: column for row, column in pairs if moves_m[row][column] <= reach_m[row]}
