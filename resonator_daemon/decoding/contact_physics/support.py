"""Where a contact is: from the linear map of the pressure to the pixels that may carry load."""

import numpy as np
from scipy import ndimage

from resonator_daemon.arrays import Bools, Floats, Labels, Singles

_THRESHOLD = 0.15  # of the largest pressure: what belongs to a contact
BLOB_PEAK = 0.25  # of the largest pressure: what a blob must reach to count as one
_BLOB_PIXELS = 2

_EIGHT = np.ones((3, 3), np.bool_)


def raw_support(pressure: Floats | Singles) -> Bools:
    """Return the pixels above the threshold, (ny, nx), and their neighbours: quick, with every blob of noise."""
    return dilated(pressure > _THRESHOLD * pressure.max())


def load_support(pressure: Floats | Singles) -> Bools:
    """Return the pixels (ny, nx) that carry load: above the threshold, in significant blobs, and their neighbours."""
    above = pressure > _THRESHOLD * pressure.max()
    labels, count = ndimage.label(above, _EIGHT)
    peaks = np.zeros(count + 1, pressure.dtype)
    np.maximum.at(peaks, labels.ravel(), pressure.ravel())
    kept = (peaks >= BLOB_PEAK * pressure.max()) & (np.bincount(labels.ravel()) >= _BLOB_PIXELS)
    kept[0] = False
    return dilated(kept[labels])


def dilated(mask: Bools, times: int = 1) -> Bools:
    """With its eight neighbours, `times` over."""
    for _ in range(times):
        wide = mask.copy()
        wide[:, 1:] |= mask[:, :-1]
        wide[:, :-1] |= mask[:, 1:]
        mask = wide.copy()
        mask[1:] |= wide[:-1]
        mask[:-1] |= wide[1:]
    return mask


def swept(mask: Bools, steps: Floats) -> Bools:
    """With what it passes on its way by `steps` pixels (y, x)."""
    passed = mask.copy()
    count = int(np.rint(np.abs(steps).max()))
    for step in range(1, count + 1):
        dy, dx = (int(shift) for shift in np.rint(steps * step / count))
        passed[_part(dy), _part(dx)] |= mask[_part(-dy), _part(-dx)]
    return passed


def blobs(mask: Bools) -> Labels:
    """Return the number of the blob of each pixel (ny, nx), from 1, and 0 outside the mask."""
    return np.asarray(ndimage.label(mask, _EIGHT)[0], np.int32)


def _part(shift: int) -> slice:
    """Return what an axis that is shifted fills."""
    return slice(shift, None) if shift >= 0 else slice(None, shift)
