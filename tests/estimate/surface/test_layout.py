"""Recognition of grids, borders and duplicate sites."""

import numpy as np
import pytest

from resonator_daemon.estimate.surface import layout

X, Y = np.meshgrid(np.arange(5) * 4e-4 - 1e-3, np.arange(4) * 6e-4)
GRID = np.column_stack([X.ravel(), Y.ravel()])


def test_grid():
    grid = layout.as_grid(GRID)
    assert grid is not None
    assert grid.shape == (4, 5)
    assert (grid.pitch_x_m, grid.pitch_y_m) == pytest.approx((4e-4, 6e-4))
    two_rows = layout.as_grid(GRID[:10])
    assert two_rows is not None
    assert two_rows.shape == (2, 5)


@pytest.mark.parametrize(
    "positions",
    [
        GRID[:-1],
        GRID[::-1],
        GRID[:, ::-1],
        GRID[:5],
        GRID[:1],
        np.random.default_rng(0).permutation(GRID),
        GRID + np.where(np.arange(20) == 7, 1e-6, 0.0)[:, None],
        GRID @ np.array([[0.8, 0.6], [-0.6, 0.8]]),
    ],
    ids=["one missing", "backwards", "y first", "a row", "a site", "shuffled", "one off", "turned"],
)
def test_no_grid(positions):
    assert layout.as_grid(positions) is None


def test_border_is_the_outermost_ring_and_what_lies_beyond():
    inside = layout.at_border(GRID, GRID).reshape(4, 5)
    assert inside[[0, -1]].all()
    assert inside[:, [0, -1]].all()
    assert not inside[1:-1, 1:-1].any()
    assert layout.at_border(GRID, np.array([[5e-3, 0.0], [-0.2e-3, 0.9e-3]])).tolist() == [True, False]


def test_duplicates_are_named():
    with pytest.raises(ValueError, match="sites 3 and 20"):
        layout.refuse_duplicates(np.vstack([GRID, GRID[3]]), np.full(21, 1e-3))
    layout.refuse_duplicates(np.vstack([GRID, GRID[3]]), np.append(np.full(20, 1e-3), 2e-3))


def test_cells_of_a_grid_are_its_pixels():
    x, y = np.meshgrid(np.arange(7) * 4e-4, np.arange(5) * 4e-4)
    np.testing.assert_allclose(layout.cell_areas_m2(np.column_stack([x.ravel(), y.ravel()])), 1.6e-7, rtol=1e-9)
    assert (layout.cell_areas_m2(GRID[:5]) > 0.0).all()


def test_gaps_are_seen_between_clumps() -> None:
    pairs = np.repeat(5e-3 * np.stack(np.meshgrid(range(5), range(5)), axis=-1).reshape(-1, 2), 2, axis=0)
    pairs[1::2, 0] += 3e-4
    assert layout.spacing_m(pairs) == pytest.approx(3e-4)
    assert 4.5e-3 < layout.gap_m(pairs) < 5.5e-3


def test_neighbours_fill_holes_of_irregular_sites() -> None:
    sites = np.random.default_rng(0).uniform(0.0, 1.0, (60, 2))
    sides = layout.neighbours(sites, np.inf)
    reached = {0}
    for _ in range(60):
        reached |= {int(b) for a, b in sides if a in reached} | {int(a) for a, b in sides if b in reached}
    assert reached == set(range(60))
    short = layout.neighbours(sites, 0.1)
    assert (np.linalg.norm(sites[short[:, 0]] - sites[short[:, 1]], axis=1) <= 0.1).all()
    assert 0 < len(short) < len(sides)
    assert not len(layout.neighbours(np.column_stack([np.arange(5.0), np.zeros(5)]), np.inf))
