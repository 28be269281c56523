"""Inverses of symmetric positive definite matrices, and how they change with rows that are removed or added.

By numpy alone: LAPACK calls of scipy would keep other threads waiting.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Reals = TypeVar("Reals", Singles, Floats)

_SMALL = 64  # rows of a matrix that is not worth halving


def inverse(matrix: Reals) -> Reals:
    """Return the inverse of a symmetric positive definite matrix."""
    factor = _inverse_factor(matrix)
    found: Reals = factor.T @ factor
    return found


def without_rows(inverse_matrix: Singles, kept: NDArray[np.intp], removed: NDArray[np.intp]) -> Singles:
    """Return the inverse of the matrix without some of its rows and columns, from that of the whole one."""
    rows = inverse_matrix.take(kept, axis=0)
    remaining: Singles = rows.take(kept, axis=1)
    if removed.size:
        across = rows.take(removed, axis=1)
        factor = _inverse_factor(inverse_matrix.take(removed, axis=0).take(removed, axis=1))
        half = across @ factor.T  # M_kr M_rr^-1 M_rk = half half'
        remaining -= half @ half.T
    return remaining


def with_rows(inverse_matrix: Singles, across: Singles, corner: Singles) -> tuple[Singles, Singles, Singles]:
    """Return the blocks (old, old), (old, new), (new, new) of the inverse with rows and columns added.

    Parameters
    ----------
    inverse_matrix
        Of the matrix so far, (k, k).
    across, corner
        Blocks of the matrix between old and new rows (k, d), and among the new ones (d, d).
    """
    spread: Singles = inverse_matrix @ across
    factor = _inverse_factor(np.asarray(corner - across.T @ spread, np.float32))
    half: Singles = spread @ factor.T
    old = np.asarray(half @ half.T, np.float32)
    old += inverse_matrix
    crossed: Singles = -(half @ factor)
    new: Singles = factor.T @ factor
    return old, crossed, new


def _inverse_factor(matrix: Reals) -> Reals:
    """Inverse of Cholesky's lower factor, by halves, so that nearly all of it is products of matrices."""
    count = len(matrix)
    if count <= _SMALL:
        smallest: Reals = np.linalg.inv(np.linalg.cholesky(matrix))
        return smallest
    half = count // 2
    factor = np.zeros_like(matrix)
    factor[:half, :half] = _inverse_factor(matrix[:half, :half])
    across = matrix[half:, :half] @ factor[:half, :half].T
    factor[half:, half:] = _inverse_factor(matrix[half:, half:] - across @ across.T)
    factor[half:, :half] = -(factor[half:, half:] @ across) @ factor[:half, :half]
    return factor
