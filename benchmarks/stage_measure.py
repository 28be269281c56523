"""Processor time in turns, and growth exponents, for `stages.py`."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

BATCH_S = 0.01  # of processor time, at least, between two readings of the clock
ROUNDS_MIN, ROUNDS_MAX, STAGE_S = 5, 40, 4.0

Clock = Callable[[], float]


class Work(NamedTuple):
    """Something to measure: `run` processes `frames` frames."""

    name: str
    run: Callable[[], object]
    frames: int = 1


class Stage(NamedTuple):
    """A stage, a peer with the same purpose, and a limit: work that any such program contains."""

    name: str
    ours: Work
    peer: Work
    limit: Work
    clock: Clock = time.process_time


class Growth(NamedTuple):
    """A stage's work by the size of what it processes."""

    stage: str
    parameter: str
    sizes: tuple[int, ...]
    build: Callable[[int], Work]


class Figures(NamedTuple):
    """Processor time of a frame in µs: median, half the interquartile range in percent; the median ratio to ours."""

    us: float
    spread_percent: float
    ratio: float


class Fit(NamedTuple):
    """Exponent of a power law with its standard error, over a range."""

    exponent: float
    std: float
    first: int
    last: int


def in_turns(works: list[Work], clock: Clock = time.process_time) -> list[Figures]:
    """Measure works in turns, so that other programs slow all of them; ratios are within one round."""
    repeats = [_repeats(work, clock) for work in works]
    rounds: list[list[float]] = []
    until_s = time.monotonic() + STAGE_S
    while len(rounds) < ROUNDS_MIN or (time.monotonic() < until_s and len(rounds) < ROUNDS_MAX):
        rounds.append([_spent_us(work, count, clock) for work, count in zip(works, repeats, strict=True)])
    spent = np.array(rounds)
    low, median, high = np.percentile(spent, [25, 50, 75], axis=0)
    ratios = np.median(spent[:, :1] / spent, axis=0)
    return [Figures(*map(float, each)) for each in zip(median, 50 * (high - low) / median, ratios, strict=True)]


def _repeats(work: Work, clock: Clock) -> int:
    """Run a work once to warm it up; return how often it runs within a batch."""
    work.run()
    spent_s = _spent_us(work, 1, clock) * work.frames * 1e-6
    return max(1, round(BATCH_S / max(spent_s, 1e-6)))


def _spent_us(work: Work, repeats: int, clock: Clock) -> float:
    started_s = clock()
    for _ in range(repeats):
        work.run()
    return (clock() - started_s) / (repeats * work.frames) * 1e6


def fit_growth(sizes: list[int], costs: list[float]) -> Fit:
    """Fit log(cost) = exponent log(size) + constant by least squares."""
    x, y = np.log(sizes), np.log(costs)
    x -= x.mean()
    exponent = float(x @ y / (x @ x))
    left = y - y.mean() - exponent * x
    std = float(np.sqrt(left @ left / max(len(x) - 2, 1) / (x @ x)))
    return Fit(exponent, std, min(sizes), max(sizes))


def grow(growth: Growth) -> tuple[list[float], Fit]:
    """Measure a work at each size, in turns; return µs of a frame, and the fit."""
    costs_us = [each.us for each in in_turns([growth.build(size) for size in growth.sizes])]
    return costs_us, fit_growth(list(growth.sizes), costs_us)
