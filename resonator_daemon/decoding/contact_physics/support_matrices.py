"""Matrices of the inverse problem on a support: made from nothing, or from those of a support that overlaps it.

Where a contact moves most pixels stay: their part of K K' and of the prior's precision is copied. Where prior and noise
stay as well, the inverse is updated by the pixels that left and those that came.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from resonator_daemon.arrays import Bools, Indices, Singles
from resonator_daemon.decoding.contact_physics.inverse import (
    cholesky_factor,
    inverse_factor,
    solve_factored,
    symmetric_product,
    with_rows,
    without_rows,
)
from resonator_daemon.decoding.contact_physics.pixels import PixelPrior
from resonator_daemon.decoding.contact_physics.signal_rows import LostRows

_CHANGED = 0.4  # share of the pixels that may be new: with more, matrices from nothing are as quick
_MOST_UPDATES = 30  # of an inverse, whose rounding errors add up


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


class _Change(NamedTuple):
    """From n pixels to others: those that stay come first, those that are new last."""

    kept: Indices  # as indices into the old ones, (k,)
    removed: Indices  # as indices into the old ones
    added: Indices  # flat indices into the lattice, (d,)

    @classmethod
    def between(cls, pixels: Indices, support: Bools) -> "_Change":
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
            change = _Change.between(before.pixels, support)
            if change.added.size <= _CHANGED * np.count_nonzero(support):
                return before.moved(model, change)
        pixels = np.flatnonzero(support)
        rows = model.rows(pixels)
        return cls(model.lost, pixels, rows, rows @ rows.T, model.prior.precision(pixels, pixels))

    def moved(self, model: Model, change: _Change) -> "SupportRows":
        """Make those of other pixels out of these."""
        old, k, n = self.pixels.size, change.kept.size, change.kept.size + change.added.size
        if k == old and n == k:
            return self
        pixels = np.concatenate([self.pixels[change.kept], change.added])
        rows = np.empty((3 * n, self.rows.shape[1]), np.float32)
        for component in range(3):
            before, after = self.rows[component * old :], rows[component * n :]
            np.take(before, change.kept, axis=0, out=after[:k], mode="clip")
        first, last = _of_components(np.arange(k), n), _of_components(np.arange(k, n), n)
        rows[last] = model.rows(change.added)
        across = rows @ rows[last].T
        gram = _joined(_square(self.gram, _of_components(change.kept, old)), across[first], across[last])
        precision_across = model.prior.precision(pixels, change.added)
        precision = np.empty((n, n), np.float32)
        precision[:k, :k] = _square(self.precision, change.kept)
        precision[:, k:], precision[k:, :k] = precision_across, precision_across[:k].T
        return SupportRows(self.lost, pixels, rows, gram, precision)


class SupportMatrices:
    """H of n pixels, and the inverse of H + shift.

    Parameters
    ----------
    model
    rows
        Of its kernel and prior.
    before
        Matrices of which the inverse is taken over as far as it is the same. They need the rows that `rows` were made
        out of.

    Attributes
    ----------
    updates
        Of the inverse, since it was made from nothing.
    """

    def __init__(self, model: Model, rows: SupportRows, before: "SupportMatrices | None" = None) -> None:
        self.model = model
        self.of_rows = rows
        self.updates = 0
        self._inverse: Singles | None = None
        if before is not None and before.model.is_that_of(model) and before.updates < _MOST_UPDATES:
            self._update(before)

    def _update(self, before: "SupportMatrices") -> None:
        """Adopt an inverse, if most of its pixels are the same."""
        rows = self.of_rows
        support = np.zeros(self.model.kernel.shape[1], np.bool_)
        support[rows.pixels] = True
        old = before.of_rows.pixels.size
        change = _Change.between(before.of_rows.pixels, support)
        k, n = change.kept.size, rows.pixels.size
        if k < (1.0 - _CHANGED) * max(n, old):
            return
        if k == n == old:
            self._inverse, self.updates = before.prepare(), before.updates
            return
        inverse = before.prepare()
        first, last = _of_components(np.arange(k), n), _of_components(np.arange(k, n), n)
        across = rows.gram[:, last]
        hessian = self.model.hessian
        blocks = with_rows(
            without_rows(inverse, _of_components(change.kept, old), _of_components(change.removed, old)),
            hessian(across[first], rows.precision[:k, k:], 0.0),
            hessian(across[last], rows.precision[k:, k:], self.model.shift),
        )
        self._inverse, self.updates = _joined(*blocks), before.updates + 1

    def prepare(self) -> Singles:
        """Return the inverse of H + shift, (3 n, 3 n): worth its making where many frames are solved."""
        if self._inverse is None:
            self._inverse = self._factor.T @ self._factor
        return self._inverse

    @cached_property
    def _factor(self) -> Singles:
        """Inverse of the lower Cholesky factor of H + shift."""
        return inverse_factor(self._hessian(self.model.shift))

    @cached_property
    def _cholesky(self) -> Singles:
        return cholesky_factor(self._hessian(0.0))

    def _hessian(self, shift: float) -> Singles:
        return self.model.hessian(self.of_rows.gram, self.of_rows.precision, shift)

    def shifted_solution(self, right_sides: Singles) -> Singles:
        """Return (H + shift)^-1 times right sides (3 n,) or (3 n, k)."""
        if self._inverse is not None:
            return symmetric_product(self._inverse, right_sides)
        return np.asarray(self._factor.T @ (self._factor @ right_sides), np.float32)

    def solution(self, right_sides: Singles) -> Singles:
        """Return H^-1 times right sides (3 n, k)."""
        return solve_factored(self._cholesky, right_sides)

    def variance(self) -> Singles:
        """Return the diagonal of the inverse of H + shift, (3 n,)."""
        if self._inverse is not None:
            return np.diag(self._inverse)
        return np.asarray(np.einsum("ij,ij->j", self._factor, self._factor), np.float32)


def _of_components(pixels: Indices, count: int) -> Indices:
    """Return the indices of the three components of some of `count` pixels, component by component."""
    return (np.arange(3)[:, None] * count + pixels).ravel()


def _square(matrix: Singles, chosen: Indices) -> Singles:
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
