import math
from itertools import permutations

import numpy as np
import pytest

from resonator_daemon.base.plate import load_plate
from resonator_daemon.extensions.planning.code_ladder import (
    CodePlacement,
    Tolerances,
    force_noise,
    guard_band,
    stamp_noise,
)

TOLERANCES = Tolerances(
    force_max_newton=10.0, temperature_span_kelvin=20.0, tempco_std=5e-8, tempco_difference_per_kelvin=3e-7,
    ageing=2e-6, pulling=25e-6, placement=15e-6, sensitivity_spread=0.0, model_error=0.0, counter_std=6e-7,
    oscillator_std=8e-7
)  # fmt: skip


def grid(columns: int, rows: int) -> CodePlacement:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return CodePlacement(np.stack([x, y], axis=-1).reshape(-1, 2) * 5e-3)


@pytest.mark.parametrize(
    ("factors", "force_ppm"),
    [
        (np.array([[-8.1] * 4, [5.0] * 4]), 131.0),  # both signs on a channel: bands grow towards each other
        (np.array([[-8.1, 5.0, -8.1, 5.0]] * 2), 81.0),
        (np.array([[8.1] * 4, [5.0] * 4]), 81.0),
    ],
)
def test_signs_that_differ_on_one_channel_add_their_forces(factors, force_ppm) -> None:
    assert 1e6 * guard_band(1e-6 * factors, TOLERANCES).force == pytest.approx(force_ppm)


def test_each_cause_has_its_share_of_the_step() -> None:
    guard = guard_band(np.full((3, 4), -8.1e-6), TOLERANCES)
    shares = [81.0, 6.0, 2.0, 2 * math.sqrt(13.8), 50.0, 30.0]
    assert [1e6 * share for share in guard] == pytest.approx(shares)
    assert 1e6 * guard.step == pytest.approx(sum(shares))


@pytest.mark.parametrize(
    ("tick_s", "jitter_s", "stamps_per_s", "millinewtons"),
    [(1e-9, 0.3e-9, 1e7, (2.8, 0.77, 0.53, 0.17)), (1 / 170e6, 0.5e-9, 1e6, (31.0, 2.9, 1.1, 0.17))],
)
def test_force_noise_is_that_of_known_counters(tick_s, jitter_s, stamps_per_s, millinewtons) -> None:
    # One channel, K = 6.3e-6 / N: figures of an independent study, given to two digits.
    for window_s, millinewton in zip((1e-3, 5e-3, 10e-3, 100e-3), millinewtons, strict=True):
        counter_std = stamp_noise(tick_s, jitter_s, stamps_per_s, window_s)
        found = 1e3 * force_noise(-6.3e-6, counter_std, window_s, 1).total_newton
        assert found == pytest.approx(millinewton, rel=0.03)


def test_four_channels_halve_the_counters_noise_and_not_the_oscillators() -> None:
    one, four = (force_noise(5e-6, 1e-9, 1e-2, channels) for channels in (1, 4))
    assert one.counter_newton == pytest.approx(2e-4)
    assert four.counter_newton == pytest.approx(1e-4)
    assert four.oscillator_newton == one.oscillator_newton > 0
    assert four.total_newton == pytest.approx(math.hypot(four.counter_newton, four.oscillator_newton))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("plate", ["grid", "quartz16"])
def test_sixteen_sites_get_sixteen_codes_and_neighbours_never_adjacent_ones(plate: str, seed: int) -> None:
    placement = grid(4, 4) if plate == "grid" else CodePlacement(load_plate("quartz16").site_positions_m)
    codes = placement.place(16, np.random.default_rng(seed))
    assert sorted(codes.tolist()) == list(range(1, 17))
    adjacent = [(i, j) for i in range(16) for j in range(i) if abs(codes[i] - codes[j]) == 1]
    assert not any(placement.neighbours[pair] for pair in adjacent)
    assert placement.too_near(codes) == []


def test_neighbours_on_a_grid_are_those_beside_and_across() -> None:
    near = grid(4, 4).neighbours
    assert near.sum(axis=1).tolist() == [3, 5, 5, 3, 5, 8, 8, 5, 5, 8, 8, 5, 3, 5, 5, 3]
    assert not near.diagonal().any()


def test_the_sites_that_couple_most_get_codes_as_far_apart_as_brute_force_finds() -> None:
    random = np.random.default_rng(4)
    for _ in range(5):
        placement = CodePlacement(random.uniform(0, 10e-3, (6, 2)))

        def taken(codes, placement=placement) -> float:
            pairs = [(i, j) for i in range(6) for j in range(i)]
            near = sum(bool(placement.neighbours[i, j] and abs(codes[i] - codes[j]) < 2) for i, j in pairs)
            strongest = placement.coupling.max()
            shares = [(placement.coupling[i, j] / strongest / (codes[i] - codes[j])) ** 2 for i, j in pairs]
            return 5.0 * near + sum(shares)

        best = min(taken(order) for order in permutations(range(6)))
        assert taken(placement.place(6, random)) <= best * 1.1


def test_neighbours_that_cannot_be_two_steps_apart_are_named() -> None:
    placement, random = grid(2, 2), np.random.default_rng(0)
    codes = placement.place(4, random)
    expected = [(i, j) for i in range(4) for j in range(i + 1, 4) if abs(codes[i] - codes[j]) == 1]
    assert placement.too_near(codes) == expected
    assert len(expected) == 3
    assert placement.too_near(placement.place(7, random)) == []
