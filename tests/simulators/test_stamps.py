"""Stamps: displaced edges against zero crossings, sums against plain loops, closed form and stamps one by one."""

import numpy as np
import numpy.typing as npt
import pytest
from brute_force_board import record_of
from scipy.optimize import brentq

from resonator_daemon.base.arrays import Floats
from simulators.beats import Beats, beat_sums, displaced_ticks
from simulators.stamp_sums import closed_form_sums
from simulators.stamps import stamped_sums
from simulators.strides import StampErrors, StampSums, StrideCounter, Strides

CARRIER = 0.00994  # turns per tick: 9.94 MHz in ticks of 1 ns
PERIOD = 10 / CARRIER


def beats(ratio: npt.ArrayLike, start_turns: npt.ArrayLike, turns_per_tick: npt.ArrayLike) -> Beats:
    """Beats (n, 1, 3) of n gates on one channel."""
    shape = (-1, 1, 3)
    fields = [np.asarray(field, dtype=float).reshape(shape) for field in (ratio, start_turns, turns_per_tick)]
    return Beats(*fields, np.full((len(fields[0]), 1), CARRIER))


def strides(first_ticks: npt.ArrayLike, stamps: int, period_ticks: float = PERIOD) -> Strides:
    first = np.asarray(first_ticks, dtype=float).reshape(-1, 1)
    gate_start = 1_000_000 * np.arange(len(first))[:, np.newaxis]
    counts = np.full(first.shape, stamps)
    return Strides(gate_start, counts * 0 + 7, counts, first, np.full(first.shape, period_ticks))


def no_errors(gates: int, jitter_ticks: float = 0.0, strayed: float = 0.0, tilt: float = 0.0) -> StampErrors:
    return StampErrors(*(np.full((gates, 1), value) for value in (jitter_ticks, strayed, tilt)))


@pytest.mark.parametrize(
    ("ratio", "tolerance"), [((0.01, 0.0, 0.0), 1e-11), ((0.4, 0.2, 0.1), 1e-11), ((0.95, 0.0, 0.0), 1e-9)]
)
def test_edges_are_where_the_sum_of_all_tones_crosses_zero(ratio: tuple[float, ...], tolerance: float) -> None:
    start, rate = np.array([0.31, 0.77, 0.05]), np.array([5.2e-5, -3.1e-5, 7.7e-5])

    def wave(ticks: float) -> float:
        phases = CARRIER * ticks + np.array([0.0, *(start + rate * ticks)])
        return float(np.array([1.0, *ratio]) @ np.sin(2 * np.pi * phases))

    edges = np.arange(3, 9900, 97) / CARRIER
    found = displaced_ticks(edges, Beats(np.array(ratio), start, rate, CARRIER))
    for edge, ours in zip(edges, found, strict=True):
        # The sum leads by at most a quarter of a period or lags by as much.
        true = brentq(wave, edge - 0.249 / CARRIER, edge + 0.249 / CARRIER, xtol=1e-12, rtol=1e-15)
        assert abs(ours - true) * CARRIER < tolerance


def root_mean_square(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))


@pytest.mark.parametrize(
    ("ratio", "total_off", "moment_off", "roughness_off"),
    [
        ((0.02, 0.0, 0.0), 1e-3, 1e-3, 5e-3),
        ((0.5, 0.0, 0.0), 0.01, 0.01, 0.02),
        ((0.9, 0.0, 0.0), 0.05, 0.03, 0.1),
        ((0.2, 0.15, 0.1), 0.04, 0.03, 0.05),
        ((0.4, 0.3, 0.2), 0.25, 0.2, 0.6),  # products of four beats are left out, and matter where they are slow
    ],
)
def test_sums_of_beats_are_those_of_displaced_edges(
    ratio: tuple[float, ...], total_off: float, moment_off: float, roughness_off: float
) -> None:
    random = np.random.default_rng(8)
    gates, stamps = 300, 990
    first = random.uniform(0, PERIOD, gates)
    # From two beats in a gate to one in 14 strides.
    rate = random.choice([-1, 1], (gates, 3)) * random.uniform(2e-6, 7e-5, (gates, 3))
    some = beats(np.tile(ratio, (gates, 1)), random.random((gates, 3)), rate)
    ours = beat_sums(strides(first, stamps), some)

    times = first[:, np.newaxis] + PERIOD * np.arange(stamps)
    moved = [displaced_ticks(row, Beats(*(field[gate, 0] for field in some))) for gate, row in enumerate(times)]
    made = np.array(moved) - times
    middle = np.arange(stamps) - (stamps - 1) / 2
    rough = (np.diff(made, 2, axis=1) ** 2).sum()
    for sums, true, tolerance in (
        (ours.first_ticks, made[:, 0], 5e-3),  # beats are taken where an edge was before it moved
        (ours.last_ticks, made[:, -1], 5e-3),
        (ours.total_ticks, made.sum(axis=1), total_off),
        (ours.moment_ticks, made @ middle, moment_off),
    ):
        assert root_mean_square(sums[:, 0] - true) < tolerance * root_mean_square(true)
    assert ours.roughness_ticks2.sum() == pytest.approx(rough, rel=roughness_off)


def test_a_record_of_stamps_is_what_its_definition_says() -> None:
    lines = strides([12.25, 873.5], 40)
    sums = stamped_sums(lines, no_errors(2), None, np.random.default_rng(1))
    for gate, first in enumerate((12.25, 873.5)):
        record = record_of([1_000_000 * gate + int(first + k * PERIOD) for k in range(40)], 7, 10)
        for name in StampSums._fields:
            assert getattr(sums, name)[gate, 0] == getattr(record, name)


@pytest.mark.parametrize("make", [closed_form_sums, stamped_sums])
def test_a_phase_that_strays_moves_mean_and_slope_as_it_says(make: object) -> None:
    stamps, strayed, tilt = 1000, 40.0, -25.0
    lines = strides([500.5], stamps, 1000.0)

    def mean_and_slope(errors: StampErrors) -> tuple[float, float, float]:
        sums = make(lines, errors, None, np.random.default_rng(1))
        n, s1, s2 = stamps, sums.s1_ticks[0, 0], sums.s2_ticks[0, 0]
        slope = 6 * (2 * s2 - (n - 1) * s1) / (n * (n**2 - 1))
        return float(sums.first_ticks[0, 0] + s1 / n), float(slope), float(sums.span_ticks[0, 0])

    straight, bent = mean_and_slope(no_errors(1)), mean_and_slope(no_errors(1, 0.0, strayed, tilt))
    assert bent[0] - straight[0] == pytest.approx(strayed, abs=0.1)
    assert (bent[1] - straight[1]) * stamps == pytest.approx(tilt, abs=0.1)
    assert abs(bent[2] - straight[2]) <= 1  # the ends stay


GATE_TICKS = 1_000_000
PERIOD_TICKS = 1000.0 + (np.sqrt(5.0) - 1.0) / 2.0  # incommensurate: rounding errors of a line are white


def brute_force_stamps(jitter_ticks: float) -> npt.NDArray[np.int64]:
    """Integer stamps (trials, n) since a gate's start, of 12,000 trials those that have the most frequent n."""
    random = np.random.default_rng(5)
    by_count: dict[int, list[npt.NDArray[np.float64]]] = {}
    for _ in range(12_000):
        true = (random.random() + np.arange(int(GATE_TICKS / PERIOD_TICKS) + 1)) * PERIOD_TICKS
        true = true[true < GATE_TICKS]
        by_count.setdefault(len(true), []).append(np.floor(true + jitter_ticks * random.standard_normal(len(true))))
    return np.array(max(by_count.values(), key=len)).astype(np.int64)


def closed_form(gates: int, jitter_ticks: float) -> StampSums:
    random = np.random.default_rng(3)
    period_ticks, silent = np.full((gates, 1), PERIOD_TICKS), np.zeros((gates, 1), dtype=np.bool_)
    counted = StrideCounter(1, 10, random).count(0, GATE_TICKS, period_ticks, silent)
    return closed_form_sums(counted, no_errors(gates, jitter_ticks), None, random)


def residuals(n: int, s1: npt.ArrayLike, s2: npt.ArrayLike, span: npt.ArrayLike) -> npt.NDArray[np.float64]:
    on_a_line = PERIOD_TICKS * np.array([n * (n - 1) / 2, n * (n - 1) * (2 * n - 1) / 6, n - 1])
    return np.stack([s1, s2, span]) - on_a_line[:, np.newaxis]


@pytest.mark.parametrize(("jitter_ticks", "q2_tolerance"), [(0.3, 0.15), (0.7, 0.03)])  # 0.3: rounding is not white
def test_sums_scatter_together_as_those_of_stamps(jitter_ticks: float, q2_tolerance: float) -> None:
    stamps = brute_force_stamps(jitter_ticks)
    n = stamps.shape[1]
    relative = stamps - stamps[:, :1]
    q2 = (np.diff(relative, 2, axis=1) ** 2).sum(axis=1)
    made = residuals(n, relative.sum(axis=1), relative @ np.arange(n), relative[:, -1])

    sums = closed_form(20_000, jitter_ticks)
    chosen = sums.stamps == n
    ours = residuals(n, sums.s1_ticks[chosen], sums.s2_ticks[chosen], sums.span_ticks[chosen])

    assert np.allclose(ours.std(axis=1), made.std(axis=1), rtol=0.03)
    assert np.allclose(np.corrcoef(ours), np.corrcoef(made), atol=0.03)
    assert sums.q2_ticks2[chosen].mean() == pytest.approx(q2.mean(), rel=0.015)
    assert sums.q2_ticks2[chosen].std() == pytest.approx(q2.std(), rel=q2_tolerance)
