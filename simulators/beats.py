"""What tones besides the captured one do to its edges: the phase of the sum of all beats against it.

Of cos(a) + sum r_j cos(a + b_j) the phase is a + arg(1 + sum r_j exp(i b_j)), so that an edge comes early by that
argument over 2 pi f. Its series, the logarithm's, sums over evenly spaced stamps in closed form.
"""

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from simulators.arrays import Floats
from simulators.strides import Strides

INTERFERERS = 3
_ORDER = 3  # of the series in all interferers: on an even ladder of tones such products of beats can be slow
_STRONGEST_ORDER = 10  # in the strongest one alone: the roughness of tones that are nearly alike needs so many
_NUDGE = 1e-12  # radians from stamp to stamp: a beat that stamps see stand still stays off the division by 0
_NEGLIGIBLE = 1e-15  # of a turn: what a term of the series displaces by less than that no sum of integers shows

_POWERS = np.array(
    [powers for powers in product(range(_ORDER + 1), repeat=INTERFERERS) if 0 < sum(powers) <= _ORDER]
    + [(power,) + (0,) * (INTERFERERS - 1) for power in range(_ORDER + 1, _STRONGEST_ORDER + 1)]
)
_WEIGHTS = np.array(
    [
        (-1) ** (sum(powers) + 1) * math.factorial(sum(powers) - 1) / math.prod(map(math.factorial, powers))
        for powers in _POWERS.tolist()
    ]
)


class Beats(NamedTuple):
    """The strongest other tones besides each captured one, (n, channels, INTERFERERS), the strongest first."""

    ratio: Floats  # of amplitudes; their sum is below 1
    start_turns: Floats  # phase against the captured tone at the gate's start
    turns_per_tick: Floats  # of that phase
    carrier_turns_per_tick: Floats  # (n, channels), of the captured tone


class BeatSums(NamedTuple):
    """Displacement of a gate's stamps by beats, each (n, channels); k counts stamps, m from their middle."""

    first_ticks: Floats
    last_ticks: Floats
    total_ticks: Floats  # sum of e_k
    moment_ticks: Floats  # sum of m e_k
    roughness_ticks2: Floats  # mean square of e_k - 2 e_(k-1) + e_(k-2), times stamps
    filtered_ticks2: Floats  # the same, weighted by the gain of that difference for white errors


def displaced_ticks(times_ticks: Floats, beats: Beats) -> Floats:
    """Return the displaced times (..., n) of undisturbed edges at times since the gate's start, by Newton's method.

    `beats` of one gate and channel: (INTERFERERS,) and a scalar.
    """
    carrier = beats.carrier_turns_per_tick
    moved = times_ticks
    for _ in range(2):  # what the first step leaves is below 1e-3 of the displacement, the second squares that
        turns = beats.start_turns + beats.turns_per_tick * moved[..., np.newaxis]
        others = beats.ratio * np.exp(2j * np.pi * turns)
        total = 1.0 + others.sum(axis=-1)
        early_turns = np.angle(total) / (2.0 * np.pi)
        rate = ((others * beats.turns_per_tick).sum(axis=-1) / total).real
        moved = moved - ((moved - times_ticks) * carrier + early_turns) / (carrier + rate)
    return moved


def beat_sums(strides: Strides, beats: Beats) -> BeatSums:
    """Return in closed form what beats add to the sums over the stamps of each gate."""
    turn = 2.0 * np.pi
    n = strides.stamps.astype(np.float64)
    span = np.maximum(n - 1.0, 0.0) * strides.period_ticks
    scale = -1.0 / (turn * beats.carrier_turns_per_tick)

    ends = np.array([strides.first_ticks, strides.first_ticks + span])[..., np.newaxis]
    angles = turn * (beats.start_turns + beats.turns_per_tick * ends)
    others = (beats.ratio * np.exp(1j * angles)).sum(axis=-1)
    first, last = scale * np.arctan2(others.imag, 1.0 + others.real)

    strongest = np.minimum(beats.ratio.reshape(-1, INTERFERERS).max(axis=0), 1.0)
    felt = np.abs(_WEIGHTS) * (strongest**_POWERS).prod(axis=1) > _NEGLIGIBLE
    powers, weights = _POWERS[felt], _WEIGHTS[felt]
    # From stamp to stamp, whole turns left out: close to them a quotient of sines would lose its digits.
    step_turns = (beats.turns_per_tick * strides.period_ticks[..., np.newaxis]) @ powers.T
    half_step = np.pi * (step_turns - np.rint(step_turns)) + _NUDGE
    count = n[..., np.newaxis]
    centre = angles[0] @ powers.T + half_step * (count - 1.0)
    size = weights * np.exp(np.log(np.maximum(beats.ratio, 1e-30)) @ powers.T) * scale[..., np.newaxis]

    sine = np.sin(half_step)
    # Sums over m of cos(2 m h) and of m sin(2 m h), h half a step.
    kernel = np.sin(count * half_step) / sine
    moment = (kernel * np.cos(half_step) - count * np.cos(count * half_step)) / (2.0 * sine)
    gain = 4.0 * sine**2  # of the second difference
    rough = (size * gain) ** 2 * (count / 2.0)
    terms = np.array([size * np.sin(centre) * kernel, size * np.cos(centre) * moment, rough, rough * gain**2])
    return BeatSums(first, last, *terms.sum(axis=-1))
