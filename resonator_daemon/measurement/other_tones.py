"""What a channel hears beside the tone that it counts: a second one bends the line that edges lie on.

A tone of amplitude ratio r shifts each edge by up to r / (2 pi f), a beat's phase at a time. The regression lets
through none of it but a little that looks like a line: what is left of the first and the last stamp tells r. Second
differences of stamps see a beat of less than a tenth of the stamps' rate hardly, so that they go on telling the noise.

The regression's own error, up to 3 r / (pi^2 d T^2) for a distance d and a gate T, changes from gate to gate with the
beat's phase: third differences of the gates' frequencies see that and no ramp of the force.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.measurement.force import FloatArray

RESIDUAL_LIMIT: Final = 8.0  # times what noise and pilot explain: beyond all of 22 000 windows of single touches
GATES_MIN: Final = 4  # for a third difference
ORDER: Final = 3
WHITE_GAIN: Final = 20.0  # of variance by third differences of white noise: 1 + 9 + 9 + 1


def end_residual_ticks2(stamps: int, span_ticks: int, s1_ticks: int, slope_ticks: float) -> float:
    """Mean square of what the regression line, of `slope_ticks` per stamp, leaves of the first and the last stamp."""
    middle, half = s1_ticks / stamps, slope_ticks * (stamps - 1) / 2
    return ((middle - half) ** 2 + (span_ticks - middle - half) ** 2) / 2


def pilot_residual_ticks2(ratio: FloatArray, frequency_hz: FloatArray, reference_hz: float) -> FloatArray:
    """Mean square by which a tone of amplitude `ratio` moves edges of `frequency_hz`."""
    moved: FloatArray = (ratio * reference_hz / (2.0 * math.pi * frequency_hz)) ** 2 / 2.0
    return moved


def hears_another_tone(
    residual_ticks2: FloatArray, noise_ticks2: FloatArray, pilot_ticks2: FloatArray
) -> NDArray[np.bool_]:
    """Tell whether the ends of a window's gates lie off their lines by more than noise and pilot explain."""
    return residual_ticks2 > RESIDUAL_LIMIT * (noise_ticks2 + pilot_ticks2)


def beat_bound_hz(
    residual_ticks2: FloatArray,
    noise_ticks2: FloatArray,
    frequency_hz: FloatArray,
    reference_hz: float,
    distance_hz: FloatArray,
    window_s: float,
) -> FloatArray:
    """Return the standard deviation of a regression over the window from the tone that ends of gates tell of.

    `distance_hz` is the least that it may be away: where it beats with the gates themselves, these do not scatter.
    """
    surplus_ticks2 = np.fmax(residual_ticks2 - noise_ticks2, 0.0)
    ratio = np.fmin(np.sqrt(2.0 * surplus_ticks2) * 2.0 * math.pi * frequency_hz / reference_hz, 1.0)
    bound: FloatArray = 3.0 * ratio / (math.pi**2 * distance_hz * window_s**2) / math.sqrt(2.0)
    return bound


def beat_std_hz(gate_hz: FloatArray, gate_std_hz: FloatArray) -> FloatArray:
    """Return what beats leave in the regression over a window of k gates, (c, k) to (c,); it falls with k^2.

    0 where there are fewer than four gates; NaN where their frequencies are.
    """
    gates = gate_hz.shape[1]
    if gates < GATES_MIN:
        return np.zeros(len(gate_hz))
    differences = gate_hz
    for _ in range(ORDER):
        differences = differences[:, 1:] - differences[:, :-1]
    scatter_hz2 = np.einsum("ck,ck->c", differences, differences) / (WHITE_GAIN * differences.shape[1])
    std: FloatArray = np.sqrt(np.maximum(scatter_hz2 - gate_std_hz**2, 0.0)) / gates**2
    return std
