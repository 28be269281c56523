"""Transfer matrices of a traction against frozen fields of tamaas, made by references/make_tamaas_fields.py."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.npyio import NpzFile
from scipy import fft

from resonator_daemon.elastic import HalfSpace, SpectralGrid
from resonator_daemon.elastic.half_space import Output


@pytest.fixture(scope="module")
def reference() -> Iterator[NpzFile]:
    with np.load(Path(__file__).with_name("references") / "tamaas_fields.npz") as arrays:
        yield arrays


def fields(reference: NpzFile, number: int, output: Output, depth_m: float) -> np.ndarray:
    traction = reference["traction"]
    shape = traction.shape[1:]
    body = HalfSpace(float(reference["youngs_modulus_pascal"]), float(reference["poisson_ratio"][number]))
    grid = SpectralGrid(shape, float(reference["pitch_m"]))
    matrix = grid.transfer_matrix(body, output, "traction", depth_m, zero="periodic")  # the traction has no mean
    return fft.irfft2(np.einsum("yxij,jyx->iyx", matrix, fft.rfft2(traction)), s=shape)


@pytest.mark.parametrize("output", ["displacement", "strain", "stress", "p_n"])
@pytest.mark.parametrize("number", range(3))
def test_inner_fields_agree(reference: NpzFile, number: int, output: Output):
    for depth_m, expected in zip(reference["depth_m"], reference[output][number], strict=True):
        found = fields(reference, number, output, depth_m)
        for row, row_expected in zip(found, expected, strict=True):
            np.testing.assert_allclose(row, row_expected, atol=1e-12 * np.abs(row_expected).max(), rtol=0)


@pytest.mark.parametrize("number", range(3))
def test_surface_displacement_agrees(reference: NpzFile, number: int):
    expected = reference["surface_displacement"][number]
    found = fields(reference, number, "displacement", 0.0)
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max(), rtol=0)
