import math

import numpy as np
import pytest
from brute_force_board import REFERENCE_HZ, Channel

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.counting import Sums, frequency_hz, merge
from resonator_daemon.measurement.sliding_window import SlidingWindow

BAND_HZ = (9e6, 11e6)


def window(frames=3):
    return SlidingWindow(frames, REFERENCE_HZ, BAND_HZ)


def frames_of(frequencies_hz, flags=None):
    channel = Channel(np.random.default_rng(9), 10, 0, 0)
    flags = flags or {}
    return [channel.gate(f, (k + 1) * 1_000_000, int(flags.get(k, 0))) for k, f in enumerate(frequencies_hz)]


def test_a_window_gives_the_merged_sums_of_its_last_gates():
    slide, frames = window(), frames_of([10e6] * 5)
    seen = []
    for frame in frames:
        assert slide.push(frame) is None
        seen.append(slide.sums())
    assert seen[:2] == [None, None]
    assert seen[2:] == [merge([Sums.of(frame) for frame in frames[k - 2 : k + 1]]) for k in (2, 3, 4)]


def test_the_last_gates_of_a_window_are_there_before_it_is_full_and_alone():
    slide, frames = window(4), frames_of([10e6 * (1 + 1e-6 * k) for k in range(6)])
    for count, frame in enumerate(frames, 1):
        slide.push(frame)
        held = [Sums.of(f) for f in frames[max(0, count - 4) : count]]
        assert [gate.sums for gate in slide.gates] == held
        assert [gate.frequency_hz for gate in slide.gates] == [frequency_hz(part, REFERENCE_HZ) for part in held]
        assert (slide.held, slide.last_hz) == (len(held), frequency_hz(held[-1], REFERENCE_HZ))
        for last in (1, 2, 3, 4):
            assert slide.sums(last) == (merge(held[-last:]) if last <= len(held) else None)


@pytest.mark.parametrize("frames", [0, -1, 4])
def test_more_gates_than_the_window_holds_are_refused(frames):
    with pytest.raises(ValueError, match=f"{frames} frames, the window has 1 to 3"):
        window(3).sums(frames)


def test_a_window_that_starts_anew_forgets_the_gates_before():
    slide, frames = window(), frames_of([10e6] * 5)
    for frame in (frames[0], frames[1], frames[4]):
        slide.push(frame)
    assert [gate.sums for gate in slide.gates] == [Sums.of(frames[4])]
    slide.push(SingleToneRecord(*[0] * 10))
    assert slide.gates == ()
    assert slide.held == 0
    assert math.isnan(slide.last_hz)
    assert slide.sums(1) is None


def full_after(slide, frames):
    return [slide.push(frame) or ("full" if slide.sums() else "filling") for frame in frames]


def test_a_flagged_gate_empties_the_window_and_the_next_starts_anew():
    flags = {3: RecordFlag.CAPTURE_SWITCH}
    told = full_after(window(), frames_of([10e6] * 8, flags))
    assert told == ["filling"] * 2 + ["full", "capture_switch"] + ["filling"] * 2 + ["full"] * 2


def test_a_stride_break_starts_the_window_anew_with_that_gate():
    told = full_after(window(), frames_of([10e6] * 7, {3: RecordFlag.STRIDE_BREAK}))
    assert told == ["filling"] * 2 + ["full"] + ["filling"] * 2 + ["full"] * 2


def test_a_missing_gate_starts_the_window_anew():
    frames = frames_of([10e6] * 8)
    del frames[3]
    assert full_after(window(), frames) == ["filling"] * 2 + ["full"] + ["filling"] * 2 + ["full"] * 2


@pytest.mark.parametrize(("jump", "restarts"), [(15e-6, False), (-15e-6, False), (25e-6, True), (-25e-6, True)])
def test_a_capture_switch_that_the_board_does_not_flag_starts_the_window_anew(jump, restarts):
    told = full_after(window(), frames_of([10e6] * 4 + [10e6 * (1 + jump)] * 3))
    after = ["filling"] * 2 + ["full"] if restarts else ["full"] * 3
    assert told == ["filling"] * 2 + ["full"] * 2 + after


@pytest.mark.parametrize("frequency", [8.9e6, 11.1e6])
def test_a_frequency_outside_the_band_is_a_fault(frequency):
    slide = window()
    assert slide.push(frames_of([frequency])[0]) == "impossible_frequency"
    assert slide.fault == "impossible_frequency"
    assert slide.sums() is None


def test_restart_forgets_gates_and_fault():
    slide = window(1)
    slide.push(frames_of([10e6])[0])
    assert slide.full
    slide.restart()
    assert not slide.full
    slide.push(SingleToneRecord(*[0] * 10))
    slide.restart()
    assert slide.fault is None


def test_a_window_of_no_gates_is_refused():
    with pytest.raises(ValueError, match="0 frames"):
        window(0)
