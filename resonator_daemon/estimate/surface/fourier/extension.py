"""Extension of an array beyond its border, so that the period of a Fourier transform does less harm."""

from typing import Literal

import numpy as np
from scipy import fft

from resonator_daemon.base.arrays import Complexes, Floats

ExtensionName = Literal["taper", "periodic"]


class ExtendedTransform:
    """Unitary Fourier transform of fields (..., ny, nx) that are extended first, and back.

    Parameters
    ----------
    shape
        (ny, nx) of the array.
    extension
        "taper", to a square of 1.5 times the longer side; "periodic", not at all.
    """

    def __init__(self, shape: tuple[int, int], extension: ExtensionName) -> None:
        self._shape = shape
        if extension == "taper":
            side = extended_length(max(shape))  # square: the displacement of an isolated load is known for that
            along, across = (extension_matrix(count, side) for count in shape)
        elif extension == "periodic":
            along, across = (np.eye(count) for count in shape)
        else:
            raise ValueError(f"extension is {extension!r}, must be 'taper' or 'periodic'")
        self.extended_shape = len(along), len(across)
        self._bins_x = len(across) // 2 + 1
        # Extension and transform in one matrix; that of x acts on real numbers, as real and imaginary columns.
        self._to_bins_y = np.asarray(fft.fft(along, axis=0, norm="ortho"), np.complex128)
        self._to_bins_x = np.ascontiguousarray(fft.rfft(across, axis=0, norm="ortho").T).view(np.float64)
        self.noise_power = noise_power(along)[:, None] * noise_power(across)[: self._bins_x]  # of unit white noise

    @property
    def samples_share(self) -> float:
        """Samples of the array over those transformed."""
        return self._shape[0] * self._shape[1] / (self.extended_shape[0] * self.extended_shape[1])

    def to_spectrum(self, fields: Floats) -> Complexes:
        """Return the bins of `rfft2` of the extended fields, flat: (..., bins)."""
        leading, (ny, nx) = fields.shape[:-2], self._shape
        rows = (fields.reshape(-1, nx) @ self._to_bins_x).view(np.complex128)
        spectrum = self._to_bins_y @ rows.reshape(*leading, ny, self._bins_x)
        return np.asarray(spectrum.reshape(*leading, -1), np.complex128)

    def to_space(self, spectrum: Complexes) -> Floats:
        """Return the fields (..., ny, nx) of the flat bins (..., bins), without what lies beyond the array."""
        ny, nx = self._shape
        columns = spectrum.reshape(*spectrum.shape[:-1], self.extended_shape[0], self._bins_x)
        rows = fft.ifft(columns, axis=-2, norm="ortho")[..., :ny, :]
        return np.asarray(fft.irfft(rows, n=self.extended_shape[1], norm="ortho")[..., :nx], np.float64)


def extended_length(count: int) -> int:
    """Even length of about 1.5 times `count` samples that transforms fast."""
    return 2 * fft.next_fast_len(-(-3 * count // 4), real=True)


def extension_matrix(count: int, length: int) -> Floats:
    """Return the matrix (length, count) that appends the last and the first sample, tapered to 0 by a cosine.

    Each taper is a quarter of the samples long, or half of what is free where that is less; the rest is 0.
    """
    free = length - count
    taper = min(-(-count // 4), free // 2)
    matrix = np.zeros((length, count))
    matrix[:count] = np.eye(count)
    weights = 0.5 + 0.5 * np.cos(np.pi * np.arange(1, taper + 1) / (taper + 0.5))
    matrix[count : count + taper, -1] = weights
    matrix[length - taper :, 0] += weights[::-1]
    return matrix


def noise_power(matrix: Floats) -> Floats:
    """Power (length,) of extended white noise of unit variance, in each bin of the unitary transform."""
    return np.asarray((np.abs(fft.fft(matrix, axis=0, norm="ortho")) ** 2).sum(axis=1), np.float64)
