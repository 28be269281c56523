"""Signals of unit tractions on single pixels, in fewer rows: what of them the load on any pixel can reach.

Signals at depth are smooth. On a grid a separable orthonormal basis, in which the noise is white, holds them in a third
of the rows; on other layouts the rows are the signals. Where signals are lost the noise of the rows is no longer white;
it is made so again.
"""

import numpy as np
from numpy.lib.stride_tricks import as_strided
from scipy.linalg import cholesky, solve_triangular

from resonator_daemon.base.arrays import Bools, Floats, Singles
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.contact_physics.pixels import PixelLattice
from resonator_daemon.estimate.surface.layout import as_grid
from resonator_daemon.estimate.surface.open_plane.prior_tables import Kernel, StationaryPrior
from resonator_daemon.estimate.surface.skin import Prior

_LOSS = 8e-4  # share of the power of all pixels' signals
_SAMPLES = 24  # pixels along each axis that are enough to choose the basis
_JITTER = 1e-6  # keeps the rows of signals that are all lost apart

_WHITE_DEPTHS = 1e-3  # correlation length over depth of a traction that is white to the signals
_PANEL = np.array([7.0, 32.0, 12.0, 32.0, 7.0]) / 90.0  # Boole's rule
_PANEL_DEPTHS = 0.5  # widest panel
_TAPS = 6  # of the interpolation between offsets
_SAME = 1e-6  # of the pitch: offsets this close are one


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
        needed = int(np.argmax(power.sum() - np.cumsum(power.ravel()[order]) <= _LOSS * power.sum())) + 1
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


def site_kernel(
    half_space: HalfSpace, positions_m: Floats, depths_m: Floats, noise_std: Floats, lattice: PixelLattice
) -> Singles:
    """Whitened signals of sites under 1 Pa on each pixel, within 1e-4 of the largest one.

    Parameters
    ----------
    half_space
    positions_m, depths_m
        Of the sites, (n, 2) and (n,).
    noise_std
        Of their signals, (3, n).
    lattice

    Returns
    -------
    Of shape (3 components, py, px, 3 channels, n), or (..., ny, nx) for sites that form a grid. Where pixels repeat the
    grid and its noise is even, this is a view of a table, each entry of which stands at many places.
    """
    grid = as_grid(positions_m)
    sites = grid.shape if grid else (len(positions_m),)
    first = (lattice.origin_m - positions_m) / lattice.pitch_m  # from each site to the first pixel, in pixels
    phases = first - np.rint(first)
    if (
        grid
        and np.ptp(depths_m) == 0.0
        and not np.ptp(noise_std, axis=1).any()
        and np.ptp(phases, axis=0).max() < _SAME
    ):
        steps = _OffsetTable(half_space, float(depths_m[0]), lattice, first).at_steps()
        steps /= noise_std[:, :1, None, None].astype(np.float32)
        return _repeated(steps, lattice.shape, grid.shape)
    kernel = np.empty((len(positions_m), 3, 3, *lattice.shape), np.float32)
    for depth_m in np.unique(depths_m):
        members = np.flatnonzero(depths_m == depth_m)
        table = _OffsetTable(half_space, float(depth_m), lattice, first[members])
        for site in members:
            kernel[site] = table.at(first[site])
    kernel /= noise_std.T.astype(np.float32)[:, :, None, None, None]
    return np.ascontiguousarray(kernel.transpose(2, 3, 4, 1, 0)).reshape(3, *lattice.shape, 3, *sites)


def _repeated(table: Singles, pixels: tuple[int, int], sites: tuple[int, int]) -> Singles:
    """Return what `site_kernel` does, for sites that are spaced as the pixels are, from whitened signals by offset."""
    channel, component, down, right = table.strides
    ny, nx = sites
    last = table[:, :, ny - 1 :, nx - 1 :]  # offsets from the grid's first site, whose pixels lie farthest ahead
    return as_strided(last, (3, *pixels, 3, ny, nx), (component, down, right, channel, -down, -right), writeable=False)


class _OffsetTable:
    """Signals at one depth, (channel, component), over the offset from a site to a pixel, in parts of the pitch.

    Parameters
    ----------
    half_space
    depth_m
    lattice
    first
        Offsets from the sites to the first pixel, in pixels, (n, 2).
    """

    def __init__(self, half_space: HalfSpace, depth_m: float, lattice: PixelLattice, first: Floats) -> None:
        pitch_m = lattice.pitch_m
        self._pixels = lattice.shape[::-1]
        self._panels = int(np.ceil(pitch_m / (_PANEL_DEPTHS * depth_m)))
        self._parts = parts = (_PANEL.size - 1) * self._panels  # of a pixel
        margin = _TAPS // 2 / parts
        self._low = first.min(axis=0) - margin
        spans = np.ptp(first, axis=0) + np.array(self._pixels) - 1 + 2.0 * margin
        axes = [
            (low + (np.arange(int(np.ceil(span * parts - _SAME)) + 1 + parts) - parts / 2) / parts) * pitch_m
            for low, span in zip(self._low, spans, strict=True)
        ]
        green = _green(half_space, depth_m, float(np.hypot(*(np.abs(axis).max() for axis in axes))))
        table = green(-np.stack(np.meshgrid(*axes), axis=-1)).transpose(2, 3, 0, 1)
        weights = np.zeros(parts + 1)
        for panel in range(self._panels):
            weights[4 * panel : 4 * panel + 5] += _PANEL * pitch_m / self._panels
        for _ in range(2):  # means over a pixel, along y and then along x
            count = table.shape[2] - parts
            parted = [weight * table[:, :, part : part + count] for part, weight in enumerate(weights)]
            table = np.sum(parted, axis=0).swapaxes(2, 3)
        # Rows a pitch apart lie together.
        self._rows = [np.ascontiguousarray(table[:, :, part::parts], np.float32) for part in range(parts)]

    def at_steps(self) -> Singles:
        """Over offsets a pitch apart, from the least on, (3, 3, offsets y, offsets x)."""
        row, part = divmod(_TAPS // 2, self._parts)
        return np.ascontiguousarray(self._rows[part][:, :, row:, _TAPS // 2 :: self._parts])

    def at(self, first: Floats) -> Singles:
        """Over all pixels for the site from which the first one lies so far, (3, 3, py, px)."""
        nx, ny = self._pixels
        (x, of_x), (y, of_y) = (_interpolation(place) for place in (first - self._low) * self._parts)
        columns = slice(x, x + (nx - 1) * self._parts + _TAPS)
        total = np.zeros((3, 3, ny, columns.stop - x), np.float32)
        for tap, weight in enumerate(of_y):
            row, part = divmod(y + tap, self._parts)
            total += weight * self._rows[part][:, :, row : row + ny, columns]
        along_x = np.zeros((total.shape[-1], nx), np.float32)
        for tap, weight in enumerate(of_x):
            along_x[np.arange(nx) * self._parts + tap, np.arange(nx)] = weight
        return total @ along_x


def _interpolation(place: float) -> tuple[int, Singles]:
    """Return the first of the entries around a place, and what each counts by Lagrange's polynomials."""
    nodes = np.arange(_TAPS) + int(place) - (_TAPS // 2 - 1)
    others = nodes[:, None] != nodes
    ratios = np.where(others, (place - nodes) / np.where(others, nodes[:, None] - nodes, 1), 1.0)
    return int(nodes[0]), ratios.prod(axis=1).astype(np.float32)


def _green(half_space: HalfSpace, depth_m: float, reach_m: float) -> Kernel:
    """Return the signals under a unit point force: the covariance of signals with a white traction of unit power."""
    length_m = _WHITE_DEPTHS * depth_m
    white = StationaryPrior(half_space, Prior(length_m, 1.0), 1.0 / (np.sqrt(4.0 * np.pi) * length_m))
    return white.kernel("sensor", depth_m, "traction", 0.0, reach_m)
