"""Every time stamp of a gate, made one by one and summed in exact integers: the judge of the closed form, and slow."""

import numpy as np

from simulators.arrays import Floats, Integers
from simulators.beats import Beats, displaced_ticks
from simulators.strides import StampErrors, StampSums, Strides


def stamped_sums(strides: Strides, errors: StampErrors, beats: Beats | None, random: np.random.Generator) -> StampSums:
    """Make the stamps of these strides and errors, and sum them as a record is defined."""
    records = np.zeros((len(StampSums._fields), *strides.stamps.shape), dtype=np.int64)
    for gate, channel in np.argwhere(strides.stamps):
        stamps = _stamps(strides, errors, beats, random, (gate, channel))
        records[:, gate, channel] = _record(stamps, strides, (gate, channel))
    return StampSums(*records)


def _stamps(
    strides: Strides, errors: StampErrors, beats: Beats | None, random: np.random.Generator, at: tuple[int, int]
) -> Integers:
    """Return the stamps (n,) of one gate on one channel, in ticks since the gate's start."""
    times = strides.first_ticks[at] + strides.period_ticks[at] * np.arange(strides.stamps[at])
    exact = times if beats is None else displaced_ticks(times, Beats(*(field[at] for field in beats)))
    strayed = _strayed(len(times), errors.strayed_ticks[at], errors.tilt_ticks[at])
    jitter = errors.jitter_ticks[at] * random.standard_normal(len(times))
    stamps: Integers = np.floor(exact + strayed + jitter).astype(np.int64)
    return stamps


def _strayed(stamps: int, mean_ticks: float, tilt_ticks: float) -> Floats:
    """Return a smooth path (stamps,) from 0 to 0 of this mean, which tilts a regression by so much from end to end."""
    share = (np.arange(stamps) + 0.5) / stamps
    path: Floats = share * (1.0 - share) * (6.0 * mean_ticks + 5.0 * tilt_ticks * (2.0 * share - 1.0))
    return path


def _record(stamps: Integers, strides: Strides, at: tuple[int, int]) -> tuple[int, ...]:
    since = stamps - stamps[0]
    return (
        int(strides.first_edge[at]),
        int(strides.gate_start_ticks[at[0], 0] + stamps[0]),
        len(stamps),
        int(since[-1]),
        int(since.sum()),
        int(since @ np.arange(len(since))),
        int((np.diff(since, 2) ** 2).sum()),
    )
