from itertools import permutations

import numpy as np
import pytest

from resonator_daemon.base.plate import load_plate
from resonator_daemon.extensions.planning.code_placement import (
    default_coupling,
    distances_m,
    measured_coupling_hz,
    missing,
    needed_steps,
    neighbours,
    place_codes,
)


def grid(columns: int, rows: int):
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return distances_m(np.stack([x, y], axis=-1).reshape(-1, 2) * 5e-3)


def test_neighbours_on_a_grid_are_those_beside_and_across() -> None:
    near = neighbours(grid(4, 4))
    assert near.sum(axis=1).tolist() == [3, 5, 5, 3, 5, 8, 8, 5, 5, 8, 8, 5, 3, 5, 5, 3]
    assert not near.diagonal().any()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("plate", ["grid", "quartz16"])
def test_sixteen_sites_get_sixteen_codes_and_neighbours_never_adjacent_ones(plate: str, seed: int) -> None:
    distance_m = grid(4, 4) if plate == "grid" else distances_m(load_plate("quartz16").site_positions_m)
    steps = needed_steps(distance_m)
    codes = place_codes(default_coupling(distance_m), 16, steps, np.random.default_rng(seed))
    assert sorted(codes.tolist()) == list(range(1, 17))
    adjacent = [(i, j) for i in range(16) for j in range(i) if abs(codes[i] - codes[j]) == 1]
    assert not any(neighbours(distance_m)[pair] for pair in adjacent)
    assert missing(codes, steps) == []


def test_the_sites_that_couple_most_get_codes_as_far_apart_as_brute_force_finds() -> None:
    random = np.random.default_rng(4)
    for _ in range(5):
        distance_m = distances_m(random.uniform(0, 10e-3, (6, 2)))
        coupling, none = default_coupling(distance_m), np.ones((6, 6), np.int64)

        def taken(codes, coupling=coupling) -> float:
            return sum((coupling[i, j] / (codes[i] - codes[j])) ** 2 for i in range(6) for j in range(i))

        best = min(taken(order) for order in permutations(range(6)))
        assert taken(place_codes(coupling, 6, none, random)) <= best * 1.1


def test_pairs_that_cannot_have_their_steps_are_named() -> None:
    distance_m = grid(2, 2)
    steps = needed_steps(distance_m)
    random = np.random.default_rng(0)
    codes = place_codes(default_coupling(distance_m), 4, steps, random)
    expected = [(i, j) for i in range(4) for j in range(i + 1, 4) if abs(codes[i] - codes[j]) == 1]
    assert missing(codes, steps) == expected
    assert len(expected) == 3
    assert missing(place_codes(default_coupling(distance_m), 7, steps, random), steps) == []


def test_measured_coupling_passes_through_its_two_points_and_asks_for_ten_times_as_much() -> None:
    distance_m = distances_m(np.array([[0.0, 0.0], [4e-3, 0.0], [9e-3, 0.0]]))
    coupling_hz = measured_coupling_hz(distance_m, (4e-3, 5e-3), (1150.0, 220.0))
    assert coupling_hz[0, 1] == pytest.approx(1150.0)
    assert coupling_hz[1, 2] == pytest.approx(220.0)
    assert coupling_hz[0, 2] == pytest.approx(1150.0 * (220.0 / 1150.0) ** 5)
    assert not coupling_hz.diagonal().any()
    steps = needed_steps(distance_m, coupling_hz / 1000.0)
    assert [steps[0, 1], steps[1, 2], steps[0, 2]] == [12, 3, 1]
    codes = place_codes(coupling_hz, 20, steps, np.random.default_rng(1))
    assert missing(codes, steps) == []
    assert abs(codes[0] - codes[1]) >= 12
