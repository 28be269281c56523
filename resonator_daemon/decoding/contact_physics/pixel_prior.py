"""Prior precision of the load on pixels, given that all other pixels carry none."""

import numpy as np
from scipy import fft

from resonator_daemon.arrays import Indices, Singles
from resonator_daemon.decoding.contact_physics.pixels import PixelLattice

_REACH = 30.0  # correlation lengths of a period: the correlation has faded to exp(-15) halfway


class PixelPrior:
    """Load of unit variance with the correlation exp(-d / l) between pixels.

    On a plane of pixels the precision depends on the offset alone: it is the inverse transform of the reciprocal of the
    correlation's transform. Its part that belongs to some pixels is their precision given 0 on all the others.

    Parameters
    ----------
    lattice
    correlation_length_m
        l.
    """

    def __init__(self, lattice: PixelLattice, correlation_length_m: float) -> None:
        length = correlation_length_m / lattice.pitch_m
        period = fft.next_fast_len(max(2 * max(lattice.shape), int(np.ceil(_REACH * length))), real=True)
        lags = np.minimum(np.arange(period), period - np.arange(period))
        spectrum = fft.rfft2(np.exp(-np.hypot(lags[:, None], lags) / length)).real
        self._table = fft.irfft2(1.0 / spectrum, (period, period))[: lattice.shape[0], : lattice.shape[1]].astype(
            np.float32
        )
        self._width = lattice.shape[1]

    def precision(self, rows: Indices, columns: Indices) -> Singles:
        """Precision between pixels of flat indices (r,) and (c,), of shape (r, c)."""
        (y, x), (other_y, other_x) = np.divmod(rows, self._width), np.divmod(columns, self._width)
        offsets = np.abs(y[:, None] - other_y) * self._width + np.abs(x[:, None] - other_x)
        precision: Singles = self._table.take(offsets)
        return precision
