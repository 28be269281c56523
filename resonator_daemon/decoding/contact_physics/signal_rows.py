"""Signals in fewer rows: what of them the load on any pixel can reach, in a basis in which the noise is white.

Signals at depth are smooth. On a grid a separable orthonormal basis holds them in a third of the rows; on other layouts
the rows are the signals. Where signals are lost the noise of the basis' rows is no longer white; it is made so again.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_LEFT_OUT = 8e-4  # share of the power of all pixels' signals
_JITTER = 1e-6  # keeps the rows of signals that are all lost apart


class SignalRows:
    """Linear model: rows of signals = kernel' times traction + white noise of unit variance.

    Parameters
    ----------
    kernel
        Whitened signals under 1 Pa on each pixel: (3, pixels, 3, n).
    shape
        (ny, nx) of the sites where they form a grid.
    """

    def __init__(self, kernel: Singles, shape: tuple[int, int] | None) -> None:
        components, pixels, channels, count = kernel.shape
        self.kernel: Singles = kernel.reshape(components, pixels, -1)  # (3, pixels, rows)
        self._bases: tuple[Singles, Singles] | None = None
        self._kept = np.arange(channels * count)
        if shape is None:
            return
        fields = kernel.reshape(-1, *shape)
        along_x = sum(
            field @ field.T for field in np.array_split(fields.transpose(2, 0, 1).reshape(shape[1], -1), 8, 1)
        )
        along_y = sum(
            field @ field.T for field in np.array_split(fields.transpose(1, 0, 2).reshape(shape[0], -1), 8, 1)
        )
        x, y = (np.linalg.eigh(np.asarray(power, np.float64))[1] for power in (along_x, along_y))
        self._bases = y.astype(np.float32), x.astype(np.float32)
        rotated = np.matmul(self._bases[0].T, fields @ self._bases[1]).reshape(components, pixels, -1)
        power = np.einsum("cpr,cpr->r", rotated, rotated, dtype=np.float64)
        order = np.argsort(power)[::-1]
        needed = int(np.argmax(power.sum() - np.cumsum(power[order]) <= _LEFT_OUT * power.sum())) + 1
        self._kept = np.sort(order[:needed])
        channel, row, column = np.unravel_index(self._kept, (channels, *shape))
        self._places = np.ravel_multi_index((column, channel, row), (shape[1], channels, shape[0]))
        self.kernel = np.ascontiguousarray(rotated[..., self._kept])

    def project(self, whitened: Singles) -> Singles:
        """From whitened signals (3 n,), lost ones 0, to rows."""
        if self._bases is None:
            return whitened
        y, x = self._bases
        columns = x.T.dot(whitened.reshape(-1, len(x)).T).reshape(-1, len(y))  # (nx, 3, ny) in two axes
        rows: Singles = columns.dot(y).take(self._places)
        return rows

    def whitener(self, known: NDArray[np.bool_]) -> "LostRows":
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
    """Transforms rows of which some noise is lost: covariance W of their noise, W = L L'.

    With whitened signals U' D s, D dropping the lost ones, W = U' D U; the model is U' D s = W U' K f + noise.
    """

    def __init__(self, covariance: Floats) -> None:
        regular = covariance + _JITTER * np.eye(len(covariance))
        lower = cholesky(regular, lower=True)
        self._transposed = lower.T.astype(np.float32)
        self._inverse = solve_triangular(lower, np.eye(len(lower)), lower=True).astype(np.float32)

    def kernel(self, kernel: Singles) -> Singles:
        """Rows of the kernel, (k, rows)."""
        return kernel @ self._transposed.T

    def signals(self, rows: Singles) -> Singles:
        return self._inverse @ rows

    def back(self, rows: Singles) -> Singles:
        """Rows such that the kernel of the whole set times them is `kernel` times `rows`."""
        return self._transposed.T @ rows
