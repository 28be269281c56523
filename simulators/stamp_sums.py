"""Integer sums over the time stamps of a gate, in closed form: no stamp is ever made.

Within a gate the frequency is constant, so every stride-th edge lies on a line. Each stamp is off it by an error e_k:
white, of the input's jitter and the tick it is rounded to; smooth, of beats and of the phase that strays. The sums of a
line are polynomials in the number of stamps; the sums of white e_k and k e_k are jointly normal, those of beats are
known. First and last stamp are drawn themselves, since they stand in a record. Rounding counts as white, which it is
not for a tone near a simple fraction of the reference without jitter: `stamps` shows that.
"""

import numpy as np

from simulators.beats import Beats, beat_sums
from simulators.strides import StampErrors, StampSums, Strides

_ROUNDING_VARIANCE = 1.0 / 12.0  # ticks^2, of a stamp rounded to its tick


def closed_form_sums(
    strides: Strides, errors: StampErrors, beats: Beats | None, random: np.random.Generator
) -> StampSums:
    """Return the sums that stamps of these strides and errors would have."""
    n = strides.stamps.astype(np.float64)
    counted = strides.stamps > 0
    first, period, jitter = strides.first_ticks - 0.5, strides.period_ticks, errors.jitter_ticks  # a tick is cut off
    span = (n - 1.0) * period
    between = np.maximum(n - 2.0, 0.0)
    middle = (n - 1.0) / 2.0
    variance = jitter**2 + _ROUNDING_VARIANCE
    noise = random.standard_normal((5, *n.shape))

    first_off, last_off = jitter * noise[:2]
    # The stamps between first and last: sum e_k, and sum k e_k split into the part that goes with it and the rest.
    total = np.sqrt(variance * between) * noise[2] + n * errors.strayed_ticks
    moment = np.sqrt(variance * between * np.maximum(between**2 - 1.0, 0.0) / 12.0) * noise[3]
    moment += n * n * errors.tilt_ticks / 12.0
    # Second differences of white errors: variance 6, covariances -4 and 1 with their neighbours.
    # Their sum of squares has the variance 2 (6^2 + 2 4^2 + 2 1^2) for each, as normal errors have it.
    q2 = 6.0 * variance * between
    q2_variance = 140.0 * variance**2 * between
    if beats is not None:
        by_beats = beat_sums(strides, beats)
        first_off += by_beats.first_ticks
        last_off += by_beats.last_ticks
        total += by_beats.total_ticks - by_beats.first_ticks - by_beats.last_ticks
        moment += by_beats.moment_ticks + middle * (by_beats.first_ticks - by_beats.last_ticks)
        q2 += by_beats.roughness_ticks2
        q2_variance += 4.0 * variance * by_beats.filtered_ticks2

    first_stamp, last_stamp = np.rint(first + first_off), np.rint(first + span + last_off)
    first_error, last_error = first_stamp - first, last_stamp - first - span
    sum_of_k = n * middle
    sum_of_k2 = sum_of_k * (2.0 * n - 1.0) / 3.0
    s1 = period * sum_of_k + total + first_error + last_error - n * first_error
    s2 = period * sum_of_k2 + middle * total + moment + (n - 1.0) * last_error - sum_of_k * first_error
    q2 += np.sqrt(q2_variance) * noise[4]

    whole = np.rint(np.array([last_stamp - first_stamp, s1, s2, np.maximum(q2, 0.0)]) * counted).astype(np.int64)
    return StampSums(
        strides.first_edge,
        (strides.gate_start_ticks + first_stamp.astype(np.int64)) * counted,
        strides.stamps,
        *whole,
    )
