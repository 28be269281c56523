"""A regular grid of surface samples: its spatial frequencies and transfer matrices, which keep real fields real."""

from dataclasses import dataclass
from itertools import product
from numbers import Integral

import numpy as np

from resonator_daemon.base.arrays import Bools, Complexes, Floats
from resonator_daemon.estimate.elastic.half_space import HalfSpace, Input, Output, ZeroRule

Window = tuple[slice, slice]


@dataclass(frozen=True)
class SpectralGrid:
    """Spatial frequencies of (ny, nx) samples, `pitch_m` apart, in the layout of `scipy.fft.rfft2`.

    Raises ValueError for a shape below 1 x 1 or a pitch that is not finite and above 0.
    """

    shape: tuple[int, int]
    pitch_m: float

    def __post_init__(self) -> None:
        if (
            not isinstance(self.shape, tuple)
            or len(self.shape) != 2
            or not all(isinstance(count, Integral) and count >= 1 for count in self.shape)
        ):
            raise ValueError(f"shape is {self.shape}, must be a tuple (ny, nx) of whole numbers, each at least 1")
        if not 0.0 < self.pitch_m < np.inf:
            raise ValueError(f"pitch_m is {self.pitch_m}, must be finite and above 0")

    @property
    def omega_x(self) -> Floats:
        """Angular frequencies in rad/m, shape (nx // 2 + 1,)."""
        return np.asarray(2.0 * np.pi * np.fft.rfftfreq(self.shape[1], self.pitch_m), np.float64)

    @property
    def omega_y(self) -> Floats:
        """Angular frequencies in rad/m, shape (ny, 1)."""
        return np.asarray(2.0 * np.pi * np.fft.fftfreq(self.shape[0], self.pitch_m)[:, None], np.float64)

    @property
    def multiplicity(self) -> Floats:
        """How many bins of the whole transform each column of the half stands for, 1 or 2; shape (nx // 2 + 1,)."""
        nx = self.shape[1]
        count = np.full(nx // 2 + 1, 2.0)
        count[0] = 1.0
        if nx % 2 == 0:
            count[-1] = 1.0
        return count

    def transfer_matrix(
        self, half_space: HalfSpace, output: Output, input: Input, depth_m: float, *, zero: ZeroRule = "isolated"
    ) -> Complexes:
        """Return the matrix of `HalfSpace.transfer_matrix` at each frequency, shape (ny, nx // 2 + 1, rows, 3).

        T(-omega) = conj T(omega) must hold on the grid. A Nyquist frequency (even ny or nx) stands for both its signs:
        its entry is the mean of the two, which removes what is odd in it. Apply before any inversion.

        Raises ValueError also where the displacement at omega = 0 is that of an isolated load and ny differs from nx.
        """
        ny, nx = self.shape
        if ny != nx and (output, input, zero) == ("displacement", "traction", "isolated"):
            raise ValueError(f"shape is {self.shape}, must be square for the displacement under an isolated load")
        signs = [
            half_space.transfer_matrix(output, input, wx, wy, depth_m, zero=zero, period_m=nx * self.pitch_m)
            for wx, wy in product(_both_signs(self.omega_x, nx), _both_signs(self.omega_y, ny))
        ]
        return np.asarray(np.mean(signs, axis=0), np.complex128)


def _both_signs(omega: Floats, count: int) -> list[Floats]:
    """List the frequencies, and again with the other sign of the Nyquist frequency where there is one."""
    if count % 2:
        return [omega]
    other = omega.copy()
    other[count // 2] *= -1.0
    return [omega, other]


def window_around(hit: Bools, margin: int = 0) -> Window:
    """Smallest window (y, x) that holds all pixels hit and a margin within the grid; all of it where none is hit."""

    def span(axis: int) -> slice:
        count = hit.shape[axis]
        at = np.flatnonzero(hit.any(axis=1 - axis))
        return slice(max(int(at[0]) - margin, 0), min(int(at[-1]) + 1 + margin, count)) if at.size else slice(0, count)

    return span(0), span(1)
