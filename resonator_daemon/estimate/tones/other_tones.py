"""Detection of a second tone on a channel: it bends the line that edges lie on.

A tone of amplitude ratio r shifts each edge by up to r / (2 pi f), a beat's phase at a time. The regression lets
through none of it but a little that looks like a line: what is left of the first and the last stamp gives r. Second
differences of stamps hardly contain a beat of less than a tenth of the stamps' rate, so that they still give the noise.

The regression's own error, up to 3 r / (pi^2 d T^2) for a distance d and a gate T, changes from gate to gate with the
beat's phase: third differences of the gates' frequencies see that and no ramp of the force.
"""

import math
from collections.abc import Sequence
from typing import Final, TypeVar

from resonator_daemon.base.arrays import Floats

RESIDUAL_LIMIT: Final = 8.0  # times what noise and pilot explain: beyond all of 22 000 windows of single touches
GATES_MIN: Final = 4  # for a third difference
WHITE_GAIN: Final = 20.0  # of variance by third differences of white noise: 1 + 9 + 9 + 1


_Number = TypeVar("_Number", float, Floats)


def end_residual_ticks2(stamps: _Number, span_ticks: _Number, s1_ticks: _Number, slope_ticks: _Number) -> _Number:
    """Return the mean square residual of first and last stamp from the line of `slope_ticks` per stamp."""
    middle, half = s1_ticks / stamps, slope_ticks * (stamps - 1) / 2
    return ((middle - half) ** 2 + (span_ticks - middle - half) ** 2) / 2


def pilot_residual_ticks2(ratio: float, frequency_hz: float, reference_hz: float) -> float:
    """Return the mean square shift of edges of `frequency_hz` by a tone of amplitude `ratio`."""
    moved_ticks = ratio * reference_hz / (2.0 * math.pi * frequency_hz)
    return moved_ticks * moved_ticks / 2.0


def has_other_tone(residual_ticks2: float, noise_ticks2: float, pilot_ticks2: float) -> bool:
    """Return whether the ends of a window's gates lie off their lines by more than noise and pilot explain."""
    return residual_ticks2 > RESIDUAL_LIMIT * (noise_ticks2 + pilot_ticks2)


def beat_bound_hz(
    residual_ticks2: float,
    noise_ticks2: float,
    frequency_hz: float,
    reference_hz: float,
    distance_hz: float,
    window_s: float,
) -> float:
    """Return the standard deviation of a regression over the window from the tone that the gates' ends show.

    `distance_hz` is the least that it may be away: where it beats with the gates themselves, these do not scatter.
    """
    surplus_ticks2 = max(residual_ticks2 - noise_ticks2, 0.0)
    ratio = min(math.sqrt(2.0 * surplus_ticks2) * 2.0 * math.pi * frequency_hz / reference_hz, 1.0)
    return 3.0 * ratio / (math.pi**2 * distance_hz * window_s**2) / math.sqrt(2.0)


def beat_std_hz(gate_hz: Sequence[float], gate_std_hz: float) -> float:
    """Return the residual of beats in the regression over a window of k gates; it falls with k^2.

    0 where there are fewer than four gates.
    """
    gates = len(gate_hz)
    if gates < GATES_MIN:
        return 0.0
    shifted = zip(gate_hz, gate_hz[1:], gate_hz[2:], gate_hz[3:], strict=False)
    differences_hz2 = [(d - a - 3.0 * (c - b)) ** 2 for a, b, c, d in shifted]
    scatter_hz2 = sum(differences_hz2) / (WHITE_GAIN * len(differences_hz2))
    surplus_hz2 = scatter_hz2 - gate_std_hz * gate_std_hz
    return math.sqrt(surplus_hz2) / gates**2 if surplus_hz2 > 0.0 else 0.0
