"""Contact patches of a decoded map: which places belong to each, its area, centroid, net force and moment."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from resonator_daemon.base.arrays import Bools, Floats, Indices, Labels
from resonator_daemon.estimate.surface.decoded import positions, positive
from resonator_daemon.estimate.surface.layout import as_grid, at_border, neighbours, spacing_m

_THRESHOLD = 0.15  # of the map's peak pressure: what belongs to a patch
_PEAK = 0.25  # of the map's peak pressure: what a patch must reach ...
_SIGNIFICANCE = 4.0  # ... and how many standard deviations
_LEAST_PLACES = 2
_NEIGHBOUR = 1.6  # spacings: the eight neighbours on a grid
_NEIGHBOUR_DEPTHS = 3.0  # up to which places with none between belong together: the map shows no gap there
_MARGIN_DEPTHS = 1.0  # around a patch, whose load still counts: the map is blurred
_CORRELATION_DEPTHS = 0.2  # over which the map's errors go together ...
_CORRELATION_REACH = 6.0  # ... times this, beyond which they do not

_EIGHT = np.ones((3, 3), np.bool_)


@dataclass(frozen=True)
class NetLoad:
    """Force and moment of a contact; components x, y, z, each (3,); the centroid, x and y, is that of the pressure."""

    force_newton: Floats
    force_std_newton: Floats
    moment_newton_m: Floats
    moment_std_newton_m: Floats
    centroid_m: Floats
    centroid_std_m: Floats


@dataclass(frozen=True)
class Patch(NetLoad):
    """One contact on the map.

    Areas and centroids are those of a blurred map: for the radius of a known shape fit the signals. Moments are about
    the origin of the plate's coordinates: (y F_z, -x F_z, x F_y - y F_x), summed.
    """

    area_m2: float
    at_border: bool  # it reaches the border of the places, so that part of its load may lie beyond
    places: Indices  # above the threshold

    @property
    def radius_m(self) -> float:
        """Of a disc of the same area."""
        return math.sqrt(self.area_m2 / math.pi)


class PatchFinder:
    """Finder of the patches on maps over the same places.

    Parameters
    ----------
    positions_m
        Places of the map, (m, 2).
    cell_area_m2
        Area that each stands for: of all, or (m,).
    depth_m
        Of the sites, which sets the map's blur.

    Raises
    ------
    ValueError
        A shape that does not fit, fewer than two places, an area or depth not above 0.
    """

    def __init__(self, positions_m: ArrayLike, cell_area_m2: ArrayLike, depth_m: float) -> None:
        self._places_m = positions("positions_m", positions_m)
        if len(self._places_m) < 2:
            raise ValueError(f"positions_m has shape {self._places_m.shape}, must be (m, 2), m at least 2")
        self._area_m2 = positive("cell_area_m2", cell_area_m2, (len(self._places_m),))
        self._depth_m = float(positive("depth_m", depth_m, ()))
        tree = cKDTree(self._places_m)
        length_m = _CORRELATION_DEPTHS * depth_m
        apart = tree.sparse_distance_matrix(tree, _CORRELATION_REACH * length_m, output_type="coo_matrix")
        # Distances of 0 count, too.
        self._correlation = csr_array((np.exp(-apart.data / length_m), (apart.row, apart.col)), shape=apart.shape)
        near = tree.query_pairs(_NEIGHBOUR * spacing_m(self._places_m), output_type="ndarray")
        self._pairs = np.vstack([near, neighbours(self._places_m, _NEIGHBOUR_DEPTHS * depth_m)])
        grid = as_grid(self._places_m)
        pitches_m = (grid.pitch_x_m, grid.pitch_y_m) if grid else (0.0, np.inf)
        # On a grid whose diagonals are short enough, neighbours are the eight around each place.
        are_eight = math.hypot(*pitches_m) <= _NEIGHBOUR * min(pitches_m)
        self._shape = grid.shape if grid and are_eight else None
        self._border = at_border(self._places_m, self._places_m)

    def find(self, traction_pascal: ArrayLike, traction_std_pascal: ArrayLike) -> list[Patch]:
        """Find patches in a map and its standard deviation, (3, m) or (3, ny, nx) each, largest normal force first.

        A map that is NaN has none. ValueError for other shapes.
        """
        traction, std = (np.asarray(field, np.float64) for field in (traction_pascal, traction_std_pascal))
        count = len(self._places_m)
        for name, field in (("traction_pascal", traction), ("traction_std_pascal", std)):
            if field.ndim not in (2, 3) or field.shape[0] != 3 or field[0].size != count:
                raise ValueError(f"{name} has shape {field.shape}, must be (3, {count}) or a grid of as many places")
        traction, std = traction.reshape(3, -1), std.reshape(3, -1)
        regions = self.regions(traction[2], std[2])
        loads = self.sums(regions, traction, std)
        patches = [self.patch(region, load) for region, load in zip(regions, loads, strict=True)]
        return sorted(patches, key=lambda patch: -float(patch.force_newton[2]))

    def regions(self, pressure_pascal: Floats, std_pascal: Floats) -> list[Indices]:
        """Return the places of each patch on a map of pressure and its standard deviation, (m,) each; NaN has none."""
        peak = float(pressure_pascal.max())
        if not peak > 0.0 or peak < _SIGNIFICANCE * float(std_pascal.min()):
            return []
        above = pressure_pascal > _THRESHOLD * peak
        places = np.flatnonzero(above)
        heights = pressure_pascal.take(places)
        high = (heights >= _PEAK * peak) & (heights >= _SIGNIFICANCE * std_pascal.take(places))
        if not high.any():
            return []
        labels = self._labels(above).take(places)
        regions = [places[labels == label] for label in sorted(set(labels[high].tolist()))]
        return [region for region in regions if region.size >= _LEAST_PLACES]

    def sums(self, regions: Sequence[Indices], traction_pascal: Floats, std_pascal: Floats) -> list[NetLoad]:
        """Sum a map and its standard deviation, (3, m) each, over each region and 1 depth around it.

        A place near several regions counts for the nearest one.
        """
        if not regions:
            return []
        members = np.concatenate(regions)
        owner = np.repeat(np.arange(len(regions)), [region.size for region in regions])
        distance, nearest = cKDTree(self._places_m[members]).query(self._places_m)
        owners = np.where(distance <= _MARGIN_DEPTHS * self._depth_m, owner[nearest], -1)
        return [
            self._sum(np.flatnonzero(owners == index), traction_pascal, std_pascal) for index in range(len(regions))
        ]

    def patch(self, region: Indices, load: NetLoad) -> Patch:
        """Patch of a region that carries a load."""
        return Patch(
            area_m2=float(self._area_m2.take(region).sum()),
            at_border=bool(self._border.take(region).any()),
            places=region,
            **vars(load),
        )

    def _labels(self, above: Bools) -> Labels:
        """Return the number of the patch of each place above the threshold, (m,)."""
        if self._shape is not None:
            return np.asarray(ndimage.label(above.reshape(self._shape), _EIGHT)[0].ravel(), np.int32)
        touching = self._pairs[above[self._pairs].all(axis=1)]
        graph = coo_array((np.ones(len(touching)), touching.T), shape=(above.size, above.size))
        return np.asarray(connected_components(graph, directed=False)[1], np.int32)

    def _sum(self, around: Indices, traction: Floats, std: Floats) -> NetLoad:
        x, y = self._places_m[around].T
        share = traction[:, around] * self._area_m2[around]
        share_std = std[:, around] * self._area_m2[around]
        force = share.sum(axis=1)
        centroid = np.array([x @ share[2], y @ share[2]]) / force[2]
        parts = np.zeros((9, len(self._places_m)))
        parts[:3, around] = share_std
        parts[3:5, around] = share_std[2] * (self._places_m[around] - centroid).T
        parts[5:, around] = share_std[[2, 2, 1, 0]] * np.array([y, x, x, y])
        spread = np.sqrt(np.einsum("sp,ps->s", parts, self._correlation @ parts.T))
        return NetLoad(
            force_newton=force,
            force_std_newton=spread[:3],
            moment_newton_m=np.array([y @ share[2], -x @ share[2], x @ share[1] - y @ share[0]]),
            moment_std_newton_m=np.array([spread[5], spread[6], np.hypot(spread[7], spread[8])]),
            centroid_m=centroid,
            centroid_std_m=spread[3:5] / abs(force[2]),
        )
