import math

import numpy as np
import pytest

from resonator_daemon.estimate.tones import other_tones
from resonator_daemon.estimate.tones.frequency_estimators import Sums
from resonator_daemon.estimate.tones.other_tones import (
    RESIDUAL_LIMIT,
    beat_std_hz,
    has_other_tone,
    pilot_residual_ticks2,
)

REFERENCE_HZ = 1e9
TONE_HZ = 10e6
STRIDE_EDGES = 100
STAMPS = 100
NOISE_TICKS2 = 0.6**2 + 1 / 12  # of stamps, quantisation included


def gates(rng, count, *, ratio=0.0, distance_hz=4000.0, noise_ticks=0.6):
    """Stamps (count, n) of edges of a tone and a weaker one `distance_hz` off: zero crossings found one by one."""
    edges = STRIDE_EDGES * np.arange(count * STAMPS)
    time_s = edges / TONE_HZ
    for _ in range(30):
        # The phase of cos(a) + r cos(a + b) is ahead of a by the angle of 1 + r exp(i b).
        beat = 2.0 * np.pi * distance_hz * time_s + 1.0
        time_s = (edges - np.angle(1.0 + ratio * np.exp(1j * beat)) / (2.0 * np.pi)) / TONE_HZ
    ticks = np.floor(time_s * REFERENCE_HZ + rng.normal(0.0, noise_ticks, time_s.shape) + 1e6).astype(np.int64)
    return ticks.reshape(count, STAMPS)


def sums_of(ticks):
    offsets = [int(t - ticks[0]) for t in ticks]
    curvature = np.diff(offsets, 2)
    return Sums(
        first_edge=0,
        first_ticks=int(ticks[0]),
        stamps=len(offsets),
        stride_edges=STRIDE_EDGES,
        span_ticks=offsets[-1],
        s1_ticks=sum(offsets),
        s2_ticks=sum(k * u for k, u in enumerate(offsets)),
        q2_ticks2=int(curvature @ curvature),
        second_differences=len(offsets) - 2,
    )


def end_residual_ticks2(sums):
    stamps = sums.stamps
    slope = 6 * (2 * sums.s2_ticks - (stamps - 1) * sums.s1_ticks) / (stamps * (stamps * stamps - 1))
    return other_tones.end_residual_ticks2(stamps, sums.span_ticks, sums.s1_ticks, slope)


@pytest.mark.parametrize("ratio", [0.1, 0.2, 0.4])
def test_a_second_tone_moves_edges_by_the_share_of_a_period_that_its_ratio_says(ratio):
    whole_beats = gates(np.random.default_rng(1), 200, ratio=ratio, distance_hz=4000.0)
    on_a_line = np.arange(whole_beats.size) * STRIDE_EDGES / TONE_HZ * REFERENCE_HZ + 1e6
    moved = whole_beats.ravel() + 0.5 - on_a_line
    predicted = pilot_residual_ticks2(ratio, TONE_HZ, REFERENCE_HZ)
    # The angle of 1 + r exp(i b) has the mean square sum r^(2n) / (2 n^2): more than its first term by r^2 / 4.
    assert np.mean(moved**2) - NOISE_TICKS2 == pytest.approx(predicted, rel=0.08)


@pytest.mark.parametrize("distance_hz", [3650.0, 4000.0, 17_300.0])
def test_a_second_tone_of_three_tenths_is_heard_at_any_distance(distance_hz):
    # Beats in step with the gates show the same phase at every end: no difference of gates tells of them.
    rng = np.random.default_rng(3)
    heard, alone = (
        [
            has_other_tone(left, NOISE_TICKS2, 0.0)
            for left in np.array(
                [end_residual_ticks2(sums_of(t)) for t in gates(rng, 1000, ratio=ratio, distance_hz=distance_hz)]
            )
            .reshape(100, 10)
            .mean(axis=1)
            .tolist()
        ]
        for ratio in (0.3, 0.0)
    )
    assert sum(heard) > 95
    assert not any(alone)


def test_a_pilot_that_is_known_is_no_other_tone():
    assert has_other_tone(10.0, 0.5, 0.0)
    assert not has_other_tone(10.0, 0.5, 1.0)
    assert not has_other_tone(math.nan, 0.5, 0.0)
    assert not has_other_tone(RESIDUAL_LIMIT * 1.4, 0.5, 1.0)


def test_white_noise_of_gates_is_no_beat_and_leaves_little():
    rng = np.random.default_rng(4)
    std = np.array([beat_std_hz(gate_hz, 2.0) for gate_hz in (10e6 + rng.normal(0.0, 2.0, (4000, 10))).tolist()])
    # Third differences tell 2 Hz to some 30 %; what they say beyond it falls with the square of ten gates.
    assert np.median(std) < 0.01
    assert std.max() < 0.05


def test_what_a_beat_leaves_is_told_whatever_ramp_is_under_it():
    gate = np.arange(10)
    beat = 5.0 * np.cos(2.0 * np.pi * 0.37 * gate)
    differences = beat[3:] - 3.0 * beat[2:-1] + 3.0 * beat[1:-2] - beat[:-3]
    expected = np.sqrt((differences**2).mean() / 20.0 - 0.1**2) / 100.0
    for ramp in (0.0, 40.0 * gate, 40.0 * gate - 3.0 * gate**2):
        assert beat_std_hz((1e7 + ramp + beat).tolist(), 0.1) == pytest.approx(expected, rel=1e-5)


def test_three_gates_tell_of_no_beat():
    assert beat_std_hz([1.0, 5.0, 1.0], 0.0) == 0.0
    assert beat_std_hz([1.0, 5.0, 1.0, 5.0], 0.0) > 0
