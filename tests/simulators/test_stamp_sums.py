"""Closed-form sums against sums over stamps made one by one."""

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from simulators.stamp_sums import closed_form_sums
from simulators.strides import StampErrors, StampSums, StrideCounter, Strides

GATE_TICKS = 1_000_000
PERIOD_TICKS = 1000.0 + (np.sqrt(5.0) - 1.0) / 2.0  # incommensurate: rounding errors of a line are white
JITTER_TICKS = 0.3


@cache
def brute_force_stamps(trials: int, gates: int, jitter_ticks: float = JITTER_TICKS) -> list[npt.NDArray[np.int64]]:
    """Integer stamps (trials, n), relative to the first gate's start, in one array for each number of stamps."""
    random = np.random.default_rng(5)
    by_count: dict[int, list[npt.NDArray[np.float64]]] = {}
    for _ in range(trials):
        true = (random.random() + np.arange(int(gates * GATE_TICKS / PERIOD_TICKS) + 1)) * PERIOD_TICKS
        true = true[true < gates * GATE_TICKS]
        by_count.setdefault(len(true), []).append(np.floor(true + jitter_ticks * random.standard_normal(len(true))))
    return [np.array(stamps).astype(np.int64) for stamps in by_count.values()]


def with_jitter(strides: Strides, jitter_ticks: float, random: np.random.Generator) -> StampSums:
    nothing = np.zeros(strides.stamps.shape)
    return closed_form_sums(strides, StampErrors(nothing + jitter_ticks, nothing, nothing), None, random)


def closed_form(frames: int, jitter_ticks: float = JITTER_TICKS) -> StampSums:
    random = np.random.default_rng(3)
    shape = (frames, 4)
    strides = StrideCounter(4, 10, random).count(
        0, GATE_TICKS, np.full(shape, PERIOD_TICKS), np.zeros(shape, dtype=np.bool_)
    )
    return with_jitter(strides, jitter_ticks, random)


def residuals(n: int, s1: npt.ArrayLike, s2: npt.ArrayLike, span: npt.ArrayLike) -> npt.NDArray[np.float64]:
    return np.stack(
        [
            s1 - PERIOD_TICKS * n * (n - 1) / 2,
            s2 - PERIOD_TICKS * n * (n - 1) * (2 * n - 1) / 6,
            span - PERIOD_TICKS * (n - 1),
        ]
    )


@pytest.mark.parametrize(("jitter_ticks", "q2_tolerance"), [(JITTER_TICKS, 0.15), (0.7, 0.03)])
def test_sums_scatter_together_as_those_of_stamps(jitter_ticks: float, q2_tolerance: float) -> None:
    stamps = max(brute_force_stamps(12_000, 1, jitter_ticks), key=len)
    n = stamps.shape[1]
    relative = stamps - stamps[:, :1]
    q2 = (np.diff(relative, 2, axis=1) ** 2).sum(axis=1)
    made = residuals(n, relative.sum(axis=1), relative @ np.arange(n), relative[:, -1])

    sums = closed_form(5_000, jitter_ticks)
    chosen = sums.stamps == n
    ours = residuals(n, sums.s1_ticks[chosen], sums.s2_ticks[chosen], sums.span_ticks[chosen])

    assert np.allclose(ours.std(axis=1), made.std(axis=1), rtol=0.03)
    assert np.allclose(np.corrcoef(ours), np.corrcoef(made), atol=0.03)
    assert sums.q2_ticks2[chosen].mean() == pytest.approx(q2.mean(), rel=0.015)
    assert sums.q2_ticks2[chosen].std() == pytest.approx(
        q2.std(), rel=q2_tolerance
    )  # little jitter: rounding is not quite white
