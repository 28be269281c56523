"""Where sites lie: whether they form a grid, how far apart they are, and which places are at their border."""

from dataclasses import dataclass

import numpy as np
import scipy  # `scipy.spatial` is imported at its first use: a daemon does without it, which saves 0.3 s

from resonator_daemon.base.arrays import Bools, Floats, Indices

_TOLERANCE = 1e-6  # of the pitch or spacing
_WIDEST = 200.0  # depths from one end of the sites to the other; beyond that, tables take minutes
_CELL_STEPS = 4  # of half a spacing: how finely cells are measured


@dataclass(frozen=True)
class Grid:
    """Regular grid of sites: rows along y, columns along x."""

    shape: tuple[int, int]
    pitch_x_m: float
    pitch_y_m: float


def spacing_m(positions_m: Floats) -> float:
    """Median distance of a site to its nearest neighbour; infinite for a single one."""
    if len(positions_m) < 2:
        return np.inf
    distances, _ = scipy.spatial.cKDTree(positions_m).query(positions_m, [2])
    return float(np.median(distances))


def gap_m(positions_m: Floats) -> float:
    """Median distance of sites that are neighbours all around; that of nearest ones is blind to clumps."""
    if grid := as_grid(positions_m):
        return max(grid.pitch_x_m, grid.pitch_y_m)
    sides = neighbours(positions_m, np.inf)
    if not len(sides):
        return spacing_m(positions_m)
    return float(np.median(np.linalg.norm(positions_m[sides[:, 0]] - positions_m[sides[:, 1]], axis=1)))


def neighbours(positions_m: Floats, farthest_m: float) -> Indices:
    """Return the pairs of sites that share a side of Delaunay's triangles, no longer than a distance, (k, 2)."""
    try:
        triangles = scipy.spatial.Delaunay(positions_m).simplices
    except scipy.spatial.QhullError:  # all on a line, or fewer than three
        return np.empty((0, 2), np.intp)
    sides = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    lengths_m = np.linalg.norm(positions_m[sides[:, 0]] - positions_m[sides[:, 1]], axis=1)
    return np.asarray(sides[lengths_m <= farthest_m], np.intp)


def refuse_duplicates(positions_m: Floats, depths_m: Floats) -> None:
    """Raise ValueError for two sites at one place and depth."""
    places, limit_m = np.column_stack([positions_m, depths_m]), _TOLERANCE * float(depths_m.min())
    if (grid := as_grid(positions_m)) and min(grid.pitch_x_m, grid.pitch_y_m) > limit_m:
        return
    pairs = scipy.spatial.cKDTree(places).query_pairs(limit_m, output_type="ndarray")
    if len(pairs):
        a, b = pairs[0]
        apart_m = np.linalg.norm(places[a] - places[b])
        limit = f"must be more than {limit_m:.3g} m, a millionth of the depth"
        raise ValueError(f"sites {a} and {b} are {apart_m:.3g} m apart, {limit}; correct pitch or positions")


def diagonal_m(positions_m: Floats, depths_m: Floats) -> float:
    """Return the extent of sites, at least four depths; ValueError for more than 200 of the least depth."""
    extent_m = max(float(np.hypot(*np.ptp(positions_m, axis=0))), 4.0 * float(depths_m.max()))
    shallow_m = float(depths_m.min())
    if extent_m > _WIDEST * shallow_m:
        span = f"{extent_m / shallow_m:.0f} depths, must be at most {_WIDEST:.0f}"
        raise ValueError(f"sites span {span}; correct positions or the depth of {shallow_m:g} m")
    return extent_m


def as_grid(positions_m: Floats) -> Grid | None:
    """Recognise the grid that positions (n, 2) form row by row, x running first; None where they form none."""
    count = len(positions_m)
    x, y = positions_m.T
    columns = int(np.argmax(x[1:] <= x[:-1])) + 1 if count > 1 else 1
    if columns < 2 or count % columns or count < 2 * columns:
        return None
    grid = Grid((count // columns, columns), float(x[1] - x[0]), float(y[columns] - y[0]))
    rows, places = np.divmod(np.arange(count), columns)
    off = np.hypot(x - x[0] - places * grid.pitch_x_m, y - y[0] - rows * grid.pitch_y_m)
    smallest = min(grid.pitch_x_m, grid.pitch_y_m)
    return grid if smallest > 0.0 and off.max() <= _TOLERANCE * count * smallest else None


def at_border(sites_m: Floats, places_m: Floats) -> Bools:
    """Return which places lie outside the sites or among the outermost of them: (m,)."""
    return np.asarray(_beyond_hull_m(sites_m, places_m) > -0.5 * spacing_m(sites_m), np.bool_)


def cell_areas_m2(positions_m: Floats) -> Floats:
    """Return the area nearest to each site, within the sites' hull or half a spacing of it, (n,)."""
    half_m = 0.5 * spacing_m(positions_m)
    step_m = half_m / _CELL_STEPS
    low, high = positions_m.min(axis=0) - half_m, positions_m.max(axis=0) + half_m
    sides = np.maximum(np.round((high - low) / step_m).astype(int), 1)
    steps = (high - low) / sides
    axes = [begin + (np.arange(side) + 0.5) * step for begin, side, step in zip(low, sides, steps, strict=True)]
    raster = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    nearest = np.asarray(scipy.spatial.cKDTree(positions_m).query(raster)[1], np.intp)
    off = np.abs(raster - positions_m[nearest]).max(axis=1)
    inside = (off <= half_m) | (_beyond_hull_m(positions_m, raster) <= 0.0)
    counts = np.bincount(nearest[inside], minlength=len(positions_m))
    return np.asarray(np.maximum(counts, 1) * steps.prod(), np.float64)  # a cell may lie between the raster's points


def _beyond_hull_m(sites_m: Floats, places_m: Floats) -> Floats:
    """Return how far places lie outside the sites' hull, below 0 inside of it, (m,); infinite where it has no area."""
    try:
        hull = scipy.spatial.ConvexHull(sites_m)
    except scipy.spatial.QhullError:  # all on a line, or fewer than three
        return np.full(len(places_m), np.inf)
    return np.asarray((places_m @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1), np.float64)
