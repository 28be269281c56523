"""Signals in fewer rows: what of them the load on any pixel can reach, in a basis in which the noise is white.

Signals at depth are smooth. On a grid a separable orthonormal basis holds them in a third of the rows; on other layouts
the rows are the signals. Where signals are lost the noise of the basis' rows is no longer white; it is made so again.
"""

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from resonator_daemon.base.arrays import Bools, Floats, Singles

_LEFT_OUT = 8e-4  # share of the power of all pixels' signals
_SAMPLES = 24  # pixels along each axis that are enough to choose the basis
_JITTER = 1e-6  # keeps the rows of signals that are all lost apart


class SignalRows:
    """Linear model: rows of signals = kernel' times traction + white noise of unit variance.

    Parameters
    ----------
    kernel
        Whitened signals under 1 Pa on each pixel, (3, py, px, 3, n), or (3, py, px, 3, ny, nx) for a grid of sites.
    """

    def __init__(self, kernel: Singles) -> None:
        components, py, px, channels, *shape = kernel.shape
        self._bases: tuple[Singles, Singles] | None = None
        self._kept = np.arange(channels * int(np.prod(shape)))
        if len(shape) == 1:
            self.kernel: Singles = kernel.reshape(components, py * px, -1)  # (3, pixels, rows)
            return
        step = max(min(py, px) // _SAMPLES, 1)
        some = np.ascontiguousarray(kernel[:, ::step, ::step])
        x, y = (_leading(fields.reshape(-1, fields.shape[-1])) for fields in (some, some.swapaxes(-1, -2)))
        self._bases = y, x
        power = np.sum((y.T @ (some @ x)) ** 2, axis=(0, 1, 2), dtype=np.float64)
        order = np.argsort(power, axis=None)[::-1]
        needed = int(np.argmax(power.sum() - np.cumsum(power.ravel()[order]) <= _LEFT_OUT * power.sum())) + 1
        self._kept = np.sort(order[:needed])
        of_channel, row, column = np.unravel_index(self._kept, (channels, *shape))
        self._places = np.ravel_multi_index((column, of_channel, row), (shape[1], channels, shape[0]))
        self.kernel = np.empty((components, py * px, needed), np.float32)
        end = 0
        for channel in range(channels):
            rows, columns = row[of_channel == channel], column[of_channel == channel]
            begin, end = end, end + rows.size
            height, width = rows.max(initial=0) + 1, columns.max(initial=0) + 1
            places = rows * width + columns
            for component, line in np.ndindex(components, py):  # few fields at a time stay in the processor's cache
                fields = np.ascontiguousarray(kernel[component, line, :, channel])
                rotated = y.T[:height] @ (fields @ x[:, :width])
                pixels = slice(line * px, (line + 1) * px)
                self.kernel[component, pixels, begin:end] = rotated.reshape(px, -1).take(places, axis=1)

    def project(self, whitened: Singles) -> Singles:
        """Return the rows of whitened signals (3 n,), lost ones 0."""
        if self._bases is None:
            return whitened
        y, x = self._bases
        columns = x.T.dot(whitened.reshape(-1, len(x)).T).reshape(-1, len(y))  # (nx, 3, ny) in two axes
        rows: Singles = columns.dot(y).take(self._places)
        return rows

    def whitener(self, known: Bools) -> "LostRows":
        """Make the noise of the rows white again where some signals (3 n,) are lost."""
        if self._bases is None:
            return LostRows(np.diag(known.astype(np.float64)))
        y, x = self._bases
        channel, row, column = np.unravel_index(self._kept, (3, y.shape[0], x.shape[0]))
        lost_channel, lost_row, lost_column = np.unravel_index(np.flatnonzero(~known), (3, y.shape[0], x.shape[0]))
        lost = y[lost_row][:, row] * x[lost_column][:, column] * (lost_channel[:, None] == channel)
        lost = lost.astype(np.float64)
        return LostRows(np.eye(self._kept.size) - lost.T @ lost)


class LostRows:
    """Transform of rows of which some noise is lost: covariance W of their noise, W = L L'.

    With whitened signals U' D s, D dropping the lost ones, W = U' D U; the model is U' D s = W U' K f + noise.
    """

    def __init__(self, covariance: Floats) -> None:
        regular = covariance + _JITTER * np.eye(len(covariance))
        lower = cholesky(regular, lower=True)
        self._transposed = lower.T.astype(np.float32)
        self._inverse = solve_triangular(lower, np.eye(len(lower)), lower=True).astype(np.float32)

    def kernel(self, kernel: Singles) -> Singles:
        """Return the rows of the kernel, (k, rows)."""
        return kernel @ self._transposed.T

    def signals(self, rows: Singles) -> Singles:
        return self._inverse @ rows

    def back(self, rows: Singles) -> Singles:
        """Return the rows such that the kernel of the whole set times them is `kernel` times `rows`."""
        return self._transposed.T @ rows


def _leading(fields: Singles) -> Singles:
    """Return the eigenvectors of the power of fields (k, n) along their axis, the leading ones first, (n, n)."""
    power = (fields.T @ fields).astype(np.float64)
    return np.ascontiguousarray(np.linalg.eigh(power)[1][:, ::-1], np.float32)
