"""Parts of the inverse problem on a support from kernel and prior: made from nothing, or from an overlapping support.

Where a contact moves most pixels stay: their part of K K' and of the prior's precision is copied.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from resonator_daemon.base.arrays import Bools, Indices, Singles
from resonator_daemon.estimate.surface.contact_physics.pixels import PixelPrior
from resonator_daemon.estimate.surface.contact_physics.signal_rows import LostRows

CHANGED = 0.4  # share of the pixels that may be new: with more, matrices from nothing are as quick


@dataclass(frozen=True)
class Model:
    """What the matrices are made for, apart from the support."""

    kernel: Singles  # rows of signals under 1 Pa on each pixel of the lattice, (3, pixels, rows)
    prior: PixelPrior
    tangential_ratio: float  # power of f_x and of f_y over that of f_z
    lost: LostRows | None
    std_pascal: float  # prior standard deviation of f_z
    noise_std: float  # of each row
    shift: float  # of the diagonal of the matrix that is inverted

    def rows(self, pixels: Indices) -> Singles:
        """Return K of some pixels, under 1 Pa, (3 n, rows)."""
        rows = self.kernel[:, pixels].reshape(3 * pixels.size, self.kernel.shape[2])
        return rows if self.lost is None else self.lost.kernel(rows)

    def hessian(self, gram: Singles, precision: Singles, shift: float) -> Singles:
        """Return a part of H, given those of K K' (3 r, 3 c) and C^-1 (r, c), with a shift of the diagonal."""
        part: Singles = gram * np.float32((self.std_pascal / self.noise_std) ** 2)
        r, c = precision.shape
        tangential = precision / np.float32(self.tangential_ratio)
        for component, block in enumerate((tangential, tangential, precision)):
            part[component * r : (component + 1) * r, component * c : (component + 1) * c] += block
        if shift:
            part.ravel()[:: 3 * c + 1] += np.float32(shift)
        return part

    def is_that_of(self, other: "Model") -> bool:
        """Return whether inverses for the one serve the other; skin and lattice are taken to be the same."""
        return (self.lost, self.std_pascal, self.noise_std) == (other.lost, other.std_pascal, other.noise_std)


class Change(NamedTuple):
    """From n pixels to others: those that stay come first, those that are new last."""

    kept: Indices  # as indices into the old ones, (k,)
    removed: Indices  # as indices into the old ones
    added: Indices  # flat indices into the lattice, (d,)

    @classmethod
    def between(cls, pixels: Indices, support: Bools) -> "Change":
        stays = support[pixels]
        fresh = support.copy()
        fresh[pixels] = False
        return cls(np.flatnonzero(stays), np.flatnonzero(~stays), np.flatnonzero(fresh))


@dataclass(frozen=True)
class SupportRows:
    """What prior and noise of a frame leave as it is; rows run over the three components, pixel by pixel in each."""

    lost: LostRows | None
    pixels: Indices  # flat indices into the lattice, in any order, (n,)
    rows: Singles  # K, signals under 1 Pa on each pixel, (3 n, rows)
    gram: Singles  # K K', (3 n, 3 n)
    precision: Singles  # C^-1 of f_z, (n, n)

    @classmethod
    def of(cls, model: Model, support: Bools, before: "SupportRows | None") -> "SupportRows":
        """Make them for a support (pixels,), out of those of another one where that overlaps it enough."""
        if before is not None and before.lost is model.lost:
            change = Change.between(before.pixels, support)
            if change.added.size <= CHANGED * np.count_nonzero(support):
                return before.moved(model, change)
        pixels = np.flatnonzero(support)
        rows = model.rows(pixels)
        return cls(model.lost, pixels, rows, rows @ rows.T, model.prior.precision(pixels, pixels))

    def moved(self, model: Model, change: Change) -> "SupportRows":
        """Make those of other pixels out of these."""
        old, k, n = self.pixels.size, change.kept.size, change.kept.size + change.added.size
        if k == old and n == k:
            return self
        pixels = np.concatenate([self.pixels[change.kept], change.added])
        rows = np.empty((3 * n, self.rows.shape[1]), np.float32)
        for component in range(3):
            before, after = self.rows[component * old :], rows[component * n :]
            np.take(before, change.kept, axis=0, out=after[:k], mode="clip")
        first, last = of_components(np.arange(k), n), of_components(np.arange(k, n), n)
        rows[last] = model.rows(change.added)
        across = rows @ rows[last].T
        gram = joined(_square(self.gram, of_components(change.kept, old)), across[first], across[last])
        precision_across = model.prior.precision(pixels, change.added)
        precision = np.empty((n, n), np.float32)
        precision[:k, :k] = _square(self.precision, change.kept)
        precision[:, k:], precision[k:, :k] = precision_across, precision_across[:k].T
        return SupportRows(self.lost, pixels, rows, gram, precision)


def of_components(pixels: Indices, count: int) -> Indices:
    """Return the indices of the three components of some of `count` pixels, component by component."""
    return (np.arange(3)[:, None] * count + pixels).ravel()


def _square(matrix: Singles, chosen: Indices) -> Singles:
    return matrix.take(chosen, axis=0).take(chosen, axis=1)


def joined(old: Singles, across: Singles, new: Singles) -> Singles:
    """Join blocks (3 k, 3 k), (3 k, 3 d) and (3 d, 3 d) of a symmetric matrix, pixels k before d in each component."""
    k, d = len(old) // 3, len(new) // 3
    n = k + d
    whole = np.empty((3, n, 3, n), np.float32)
    whole[:, :k, :, :k] = old.reshape(3, k, 3, k)
    whole[:, :k, :, k:] = across.reshape(3, k, 3, d)
    whole[:, k:, :, :k] = across.T.reshape(3, d, 3, k)
    whole[:, k:, :, k:] = new.reshape(3, d, 3, d)
    return whole.reshape(3 * n, 3 * n)
