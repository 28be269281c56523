"""Inverses of symmetric positive definite matrices, and how they change with rows that are removed or added."""

import numpy as np
from scipy.linalg import blas, lapack

from resonator_daemon.arrays import Indices, Singles

_SMALL = 64  # rows of a matrix that is not worth halving


def cholesky_factor(matrix: Singles) -> Singles:
    """Return the lower Cholesky factor L of a symmetric positive definite matrix.

    What stands above its diagonal has no meaning. LinAlgError if the matrix is not positive definite.
    """
    factor, failed = lapack.spotrf(matrix.T, clean=0)
    if failed:
        raise np.linalg.LinAlgError("matrix is not positive definite")
    lower: Singles = factor.T
    return lower


def symmetric_product(matrix: Singles, right_sides: Singles) -> Singles:
    """Return a symmetric matrix times right sides (n,) or (n, k); for a single one, half of the matrix is read."""
    product: Singles = blas.ssymv(1.0, matrix.T, right_sides) if right_sides.ndim == 1 else matrix @ right_sides
    return product


def without_rows(inverse_matrix: Singles, kept: Indices, removed: Indices) -> Singles:
    """Return the inverse of the matrix without some of its rows and columns, from that of the whole one."""
    rows = inverse_matrix.take(kept, axis=0)
    remaining: Singles = rows.take(kept, axis=1)
    if removed.size:
        across = rows.take(removed, axis=1)
        factor = inverse_factor(inverse_matrix.take(removed, axis=0).take(removed, axis=1))
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
    factor = inverse_factor(np.asarray(corner - across.T @ spread, np.float32))
    half: Singles = spread @ factor.T
    old = np.asarray(half @ half.T, np.float32)
    old += inverse_matrix
    crossed: Singles = -(half @ factor)
    new: Singles = factor.T @ factor
    return old, crossed, new


def inverse_factor(matrix: Singles) -> Singles:
    """Return the inverse of the lower Cholesky factor of a symmetric positive definite matrix."""
    return _triangle_inverse(cholesky_factor(matrix))


def _triangle_inverse(lower: Singles) -> Singles:
    """Return the inverse of a lower triangle, by halves, so that nearly all of it is products of matrices."""
    count = len(lower)
    if count <= _SMALL:
        smallest: Singles = np.tril(lapack.strtri(lower.T)[0].T)
        return smallest
    half = count // 2
    found = np.zeros((count, count), np.float32)
    first = found[:half, :half] = _triangle_inverse(lower[:half, :half])
    last = found[half:, half:] = _triangle_inverse(lower[half:, half:])
    found[half:, :half] = -(last @ (lower[half:, :half] @ first))
    return found
