"""Values at scattered sites as pixels of a map: each pixel within the outline takes that of the site nearest to it."""

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from resonator_daemon.view.maps import OUTSIDE_PASCAL, Point, inside_outline

_PIXELS: Final = 32  # along the longer side
_NOWHERE: Final = -1


def as_pixels(
    values_pascal: NDArray[np.floating], outline_m: tuple[Point, ...], positions_m: tuple[Point, ...]
) -> NDArray[np.float64]:
    """Return values (n,) at positions (n, 2) as (ny, nx), row 0 at the least y, for `traction_map`."""
    nearest = _nearest_sites(outline_m, positions_m)
    return np.where(nearest == _NOWHERE, OUTSIDE_PASCAL, np.asarray(values_pascal, np.float64)[nearest])


@lru_cache(maxsize=16)
def _nearest_sites(outline_m: tuple[Point, ...], positions_m: tuple[Point, ...]) -> NDArray[np.intp]:
    low, high = np.min(outline_m, axis=0), np.max(outline_m, axis=0)
    pitch_m = float(np.max(high - low)) / _PIXELS
    nx, ny = np.ceil((high - low) / pitch_m - 1e-6).astype(int)
    x, y = np.meshgrid(
        (low[0] + high[0]) / 2 + (np.arange(nx) - (nx - 1) / 2) * pitch_m,
        (low[1] + high[1]) / 2 + (np.arange(ny) - (ny - 1) / 2) * pitch_m,
    )
    _, nearest = cKDTree(np.array(positions_m)).query(np.stack([x, y], axis=-1))
    return np.where(inside_outline(outline_m, x, y), nearest, _NOWHERE)
