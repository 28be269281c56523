"""Parity and reduced bases of a grid against the same matrices written out."""

import numpy as np
import pytest

from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.layout import Grid
from resonator_daemon.estimate.surface.open_plane.decoder import SiteCovariance
from resonator_daemon.estimate.surface.open_plane.estimate_power import CLASSES, FIELDS
from resonator_daemon.estimate.surface.open_plane.grid_bases import Bases, Reduction
from resonator_daemon.estimate.surface.open_plane.grid_modes import LEVELS, GridCovariance, GridModes
from resonator_daemon.estimate.surface.open_plane.modes import DenseModes
from resonator_daemon.estimate.surface.open_plane.prior_tables import StationaryPrior
from resonator_daemon.estimate.surface.skin import Prior

PRIOR = StationaryPrior(HalfSpace(2e5, 0.3), Prior(1e-3, 0.3), 10.0)
DEPTH = 1e-3
NOISE = np.array([2e-5, 1e-5, 3e-5])
SCALES = np.logspace(-2, 4, 7)


def positions(grid: Grid):
    ny, nx = grid.shape
    x, y = np.meshgrid(np.arange(nx) * grid.pitch_x_m, np.arange(ny) * grid.pitch_y_m)
    return np.column_stack([x.ravel(), y.ravel()])


def covariance(grid: Grid) -> SiteCovariance:
    return SiteCovariance(PRIOR, positions(grid), np.full(grid.shape[0] * grid.shape[1], DEPTH))


@pytest.mark.parametrize("shape", [(4, 6), (5, 7), (6, 5)])
def test_four_classes_hold_all_of_each_covariance(shape: tuple[int, int]):
    """With nothing left out, the products' covariances and vectors give the whole matrix back."""
    grid = Grid(shape, 4e-4, 5e-4)
    grid_covariance = GridCovariance(PRIOR, grid, DEPTH, NOISE, 1e6)
    bases = grid_covariance.bases(1e6, dict.fromkeys(FIELDS, 0.0))
    for field, table in grid_covariance.tables.items():
        whole = covariance(grid).signals() if field == "sensor" else covariance(grid).surface(field, positions(grid))
        noise = np.repeat(NOISE, shape[0] * shape[1])
        whole /= noise if field != "sensor" else noise * noise[:, None]
        reduction = Reduction(table, bases[field], bases["sensor"])
        rebuilt = np.zeros_like(whole)
        for index in range(len(CLASSES)):
            rows, columns = (products(bases[name], index) for name in (field, "sensor"))
            rebuilt += rows @ reduction.block(index) @ columns.T
        assert np.abs(rebuilt - whole).max() < 1e-12 * np.abs(whole).max()


def products(bases: Bases, index: int):
    """Fields (3 ny nx, kept) of the products that a class keeps."""
    x, channel, y = np.unravel_index(bases.places[index], (bases.x.shape[1], 3, bases.y.shape[1]))
    fields = np.zeros((3, len(bases.y), len(bases.x), channel.size))
    fields[channel, :, :, np.arange(channel.size)] = bases.y.T[y][:, :, None] * bases.x.T[x][:, None]
    return fields.reshape(-1, channel.size)


@pytest.mark.parametrize("shape", [(10, 12), (9, 11)])
def test_reduced_modes_solve_the_dense_system(shape: tuple[int, int]):
    """Any signals, also rough ones, at a scale for which the bases were made."""
    grid, count = Grid(shape, 4e-4, 3.5e-4), shape[0] * shape[1]
    modes = GridModes(GridCovariance(PRIOR, grid, DEPTH, NOISE, SCALES[-1]), LEVELS[-1])
    noise, signals = np.repeat(NOISE, count), covariance(grid).signals()
    traction, displacement = (covariance(grid).surface(field, positions(grid)) for field in FIELDS if field != "sensor")
    scale = 100.0
    frame = np.random.default_rng(0).standard_normal(3 * count) * noise
    power, vectors = np.linalg.eigh(scale * signals)
    frame += vectors @ (np.sqrt(np.maximum(power, 0.0)) * np.random.default_rng(1).standard_normal(3 * count))
    solved = np.linalg.solve(scale * signals + np.diag(noise**2), frame)
    weighted = scale / (scale * modes.eigenvalues + 1.0) * modes.project((frame / noise).astype(np.float32))
    for found, matrix in (
        (modes.traction(weighted.astype(np.float32)), traction),
        (modes.displacement(weighted.astype(np.float32)), displacement),
    ):
        expected = scale * matrix @ solved
        assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected)

    explained = [
        np.einsum("ij,ji->i", q * traction, np.linalg.solve(q * signals + np.diag(noise**2), q * traction.T))
        for q in SCALES
    ]
    variance = SCALES[:, None] * np.repeat(PRIOR.traction_variance, count)
    for kept in (modes, DenseModes(signals, traction, displacement, noise, SCALES)):
        assert variance - kept.explained_variance(SCALES) == pytest.approx(variance - explained, rel=0.02)


def test_faint_signals_need_few_modes():
    whole = GridCovariance(PRIOR, Grid((32, 32), 4e-4, 4e-4), DEPTH, NOISE, SCALES[-1])
    sizes = [GridModes(whole, level).eigenvalues.size for level in LEVELS[:3]]
    assert sizes == sorted(sizes)
    assert sizes[0] < 800 < sizes[2] < 1500
