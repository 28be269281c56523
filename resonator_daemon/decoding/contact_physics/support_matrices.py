"""Matrices of the inverse problem on a support: made from nothing, or from those of a support that overlaps it.

Where a contact moves most pixels stay: their part of A A' and of the prior's precision is copied, and the inverse is
updated by the pixels that left and those that came.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.contact_physics.inverse import inverse, with_rows, without_rows
from resonator_daemon.decoding.contact_physics.pixel_prior import PixelPrior
from resonator_daemon.decoding.contact_physics.signal_rows import LostRows

Singles = NDArray[np.float32]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.intp]

_CHANGED = 0.4  # share of the pixels that may leave or come: with more, matrices from nothing are as quick
_MOST_UPDATES = 30  # of an inverse, whose rounding errors add up


@dataclass(frozen=True)
class Model:
    """What the matrices are made for, apart from the support.

    Matrices may be taken over only between problems of the same model.
    """

    kernel: Singles  # rows of signals under 1 Pa on each pixel of the lattice, (3, pixels, rows)
    prior: PixelPrior
    tangential_ratio: float  # power of f_x and of f_y over that of f_z
    lost: LostRows | None
    std_pascal: float  # prior standard deviation of f_z
    noise_std: float  # of each row
    shift: float  # of the diagonal of the matrix that is inverted

    def rows(self, pixels: Pixels) -> Singles:
        """Return A of some pixels, (3 n, rows)."""
        rows = self.kernel[:, pixels].reshape(3 * pixels.size, self.kernel.shape[2])
        if self.lost is not None:
            rows = self.lost.kernel(rows)
        rows *= np.float32(self.std_pascal)
        return rows

    def hessian(self, gram: Singles, precision: Singles, shift: float) -> Singles:
        """Return a part of H, given those of A A' (3 r, 3 c) and C^-1 (r, c), with a shift of the diagonal."""
        part: Singles = gram / np.float32(self.noise_std**2)
        r, c = precision.shape
        for component, ratio in enumerate((self.tangential_ratio, self.tangential_ratio, 1.0)):
            block = part[component * r : (component + 1) * r, component * c : (component + 1) * c]
            block += precision / np.float32(ratio)
        if shift:
            part.ravel()[:: 3 * c + 1] += np.float32(shift)
        return part

    def is_that_of(self, other: "Model") -> bool:
        """Whether matrices for the one serve the other; skin and lattice are taken to be the same."""
        return (self.lost, self.std_pascal, self.noise_std) == (other.lost, other.std_pascal, other.noise_std)


@dataclass(frozen=True)
class SupportMatrices:
    """Matrices of n pixels; rows run over the three components of the traction, pixel by pixel in each."""

    pixels: Pixels  # flat indices into the lattice, in any order, (n,)
    rows: Singles  # A, (3 n, rows)
    gram: Singles  # A A', (3 n, 3 n)
    precision: Singles  # C^-1 of f_z, (n, n)
    inverse: Singles  # of H + shift, (3 n, 3 n)
    updates: int = 0  # since the matrices were made from nothing

    @classmethod
    def of(cls, model: Model, support: Mask) -> "SupportMatrices":
        """Make matrices from nothing for a support (pixels,)."""
        pixels = np.flatnonzero(support)
        rows = model.rows(pixels)
        gram: Singles = rows @ rows.T
        precision = model.prior.precision(pixels, pixels)
        return cls(pixels, rows, gram, precision, inverse(model.hessian(gram, precision, model.shift)))

    def serve(self, support: Mask) -> bool:
        """Whether matrices for a support (pixels,) are sooner made from these than from nothing."""
        kept, largest = int(support[self.pixels].sum()), max(int(support.sum()), self.pixels.size)
        return self.updates < _MOST_UPDATES and kept >= (1.0 - _CHANGED) * largest

    def moved(self, model: Model, support: Mask) -> "SupportMatrices":
        """Make matrices of the same model for another support (pixels,) out of these."""
        stays = support[self.pixels]
        fresh = support.copy()
        fresh[self.pixels] = False
        old, kept, added = self.pixels.size, np.flatnonzero(stays), np.flatnonzero(fresh)
        n, k = kept.size + added.size, kept.size
        pixels = np.concatenate([self.pixels[kept], added])
        in_old, out_of_old = _of_components(kept, old), _of_components(np.flatnonzero(~stays), old)
        first, last = _of_components(np.arange(k), n), _of_components(np.arange(k, n), n)

        rows = np.empty((3 * n, self.rows.shape[1]), np.float32)
        for component in range(3):
            before, after = self.rows[component * old :], rows[component * n :]
            np.take(before, kept, axis=0, out=after[:k], mode="clip")
        rows[last] = model.rows(added)
        gram_across = rows @ rows[last].T
        precision_across = model.prior.precision(pixels, added)
        precision = np.empty((n, n), np.float32)
        precision[:k, :k] = _square(self.precision, kept)
        precision[:, k:], precision[k:, :k] = precision_across, precision_across[:k].T
        inverse_blocks = with_rows(
            without_rows(self.inverse, in_old, out_of_old),
            model.hessian(gram_across[first], precision_across[:k], 0.0),
            model.hessian(gram_across[last], precision_across[k:], model.shift),
        )
        return SupportMatrices(
            pixels,
            rows,
            _joined(_square(self.gram, in_old), gram_across[first], gram_across[last]),
            precision,
            _joined(*inverse_blocks),
            self.updates + 1,
        )


def _of_components(pixels: Pixels, count: int) -> Pixels:
    """Return the indices of the three components of some of `count` pixels, component by component."""
    return (np.arange(3)[:, None] * count + pixels).ravel()


def _square(matrix: Singles, chosen: Pixels) -> Singles:
    return matrix.take(chosen, axis=0).take(chosen, axis=1)


def _joined(old: Singles, across: Singles, new: Singles) -> Singles:
    """Join blocks (3 k, 3 k), (3 k, 3 d) and (3 d, 3 d) of a symmetric matrix, pixels k before d in each component."""
    k, d = len(old) // 3, len(new) // 3
    n = k + d
    whole = np.empty((3, n, 3, n), np.float32)
    whole[:, :k, :, :k] = old.reshape(3, k, 3, k)
    whole[:, :k, :, k:] = across.reshape(3, k, 3, d)
    whole[:, k:, :, :k] = across.T.reshape(3, d, 3, k)
    whole[:, k:, :, k:] = new.reshape(3, d, 3, d)
    return whole.reshape(3 * n, 3 * n)
