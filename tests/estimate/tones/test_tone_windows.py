import math

import numpy as np
import pytest
from brute_force_board import REFERENCE_HZ, Channel, payload_of, record_of

from firmware_protocol.layouts import RecordFlag
from resonator_daemon.estimate.tones.frequency_estimators import Sums, frequency_hz, merge_adjacent
from resonator_daemon.estimate.tones.record_checks import read_gates
from resonator_daemon.estimate.tones.tone_windows import ToneWindows

BAND_HZ = (9e6, 11e6)


def windows(frames=3):
    return ToneWindows(1, frames, REFERENCE_HZ, BAND_HZ)


def frames_of(frequencies_hz, flags=None, start_ticks=0):
    channel = Channel(np.random.default_rng(9), 10, 0, start_ticks)
    flags = flags or {}
    return [
        channel.gate(f, start_ticks + (k + 1) * 1_000_000, int(flags.get(k, 0))) for k, f in enumerate(frequencies_hz)
    ]


def expected(records):
    """Sums of adjacent records, by the definition, without where they begin."""
    return merge_adjacent([Sums.of(record) for record in records])._replace(first_edge=0, first_ticks=0)


def without_start(sums):
    return [None if part is None else part._replace(first_edge=0, first_ticks=0) for part in sums]


def full_after(slide, records):
    """What each record has made of the window, all pushed at once."""
    block = slide.push(payload_of(records))
    return [
        block.window(gate, 1).faults[0] or ("full" if block.held[gate][0] == slide.frames else "filling")
        for gate in range(len(block.held))
    ]


@pytest.mark.parametrize("frames", [1, 3, 40, 500])
def test_a_window_has_the_sums_of_its_last_gates(frames):
    slide = windows(frames)
    records = frames_of([10e6 * (1 + 1e-7 * (k % 7)) for k in range(520)], start_ticks=2**32 - 9)
    for start, end in ((0, 1), (1, 510), (510, 515), (515, 520)):
        block = slide.push(payload_of(records[start:end]))
        gates = sorted({0, len(block.held) // 2, len(block.held) - 1})
        for last in {1, min(2, frames), frames}:
            for gate in gates:
                window, held = block.window(gate, last), records[: start + gate + 1]
                if last > len(held):
                    assert window.sums == [None]
                    assert math.isnan(window.frequency_hz[0])
                    continue
                wanted = expected(held[-last:])
                assert without_start(window.sums) == [wanted]
                assert window.frequency_hz == [frequency_hz(wanted, REFERENCE_HZ)]
                left = [residual for _, _, residual in read_gates(held[-last:], REFERENCE_HZ, (1e6, 1e9))]
                assert window.residual_ticks2 == [sum(left) / last]
        assert [held for (held,) in block.held] == [min(start + gate + 1, frames) for gate in range(len(block.held))]


def test_the_largest_gates_that_there_are_do_not_overflow():
    # 65 535 stamps, 65 535 ticks apart: their second sum has 63 bits, that of two gates 66.
    stamps, interval = 65_535, 65_535
    first = range(0, 4 * stamps, stamps)
    records = [record_of(range(k * interval, (k + stamps) * interval, interval), k, 1) for k in first]
    hertz = REFERENCE_HZ / interval
    window = ToneWindows(1, 4, REFERENCE_HZ, (0.9 * hertz, 1.1 * hertz)).push(payload_of(records)).window(3, 4)
    assert without_start(window.sums) == [expected(records)]
    assert window.frequency_hz == pytest.approx([hertz], rel=1e-15)


def test_a_flagged_gate_empties_the_window_and_the_next_starts_anew():
    flags = {3: RecordFlag.CAPTURE_SWITCH}
    states = full_after(windows(), frames_of([10e6] * 8, flags))
    assert states == ["filling"] * 2 + ["full", "capture_switch"] + ["filling"] * 2 + ["full"] * 2


def test_a_stride_break_and_a_missing_gate_start_the_window_anew_with_the_gate_behind():
    missing = frames_of([10e6] * 8)
    del missing[3]
    for frames in (frames_of([10e6] * 7, {3: RecordFlag.STRIDE_BREAK}), missing):
        assert full_after(windows(), frames) == ["filling"] * 2 + ["full"] + ["filling"] * 2 + ["full"] * 2


@pytest.mark.parametrize(("jump", "restarts"), [(15e-6, False), (-15e-6, False), (25e-6, True), (-25e-6, True)])
def test_a_capture_switch_that_the_board_does_not_flag_starts_the_window_anew(jump, restarts):
    states = full_after(windows(), frames_of([10e6] * 4 + [10e6 * (1 + jump)] * 3))
    after = ["filling"] * 2 + ["full"] if restarts else ["full"] * 3
    assert states == ["filling"] * 2 + ["full"] * 2 + after


def test_a_restart_forgets_the_gates():
    slide, records = windows(2), frames_of([10e6] * 5)
    assert full_after(slide, records[:3]) == ["filling", "full", "full"]
    slide.restart()
    assert full_after(slide, records[3:]) == ["filling", "full"]


def test_another_length_keeps_the_newest_gates():
    slide, records = windows(3), frames_of([10e6] * 9)
    slide.push(payload_of(records[:5]))
    slide.resize(5)
    block = slide.push(payload_of(records[5:7]))
    assert block.held == [[4], [5]]
    assert without_start(block.window(1, 5).sums) == [expected(records[2:7])]
    slide.resize(2)
    block = slide.push(payload_of(records[7:8]))
    assert block.held == [[2]]
    assert without_start(block.window(0, 2).sums) == [expected(records[6:8])]


@pytest.mark.parametrize(
    "change",
    [
        {"first_edge": 1000 + 1},
        {"first_edge": 1000 - 10},
        {"first_edge": 1000 + (1 << 20)},
        {"stride_edges": 11},
        {"first_ticks": 100 * 1000 - 1000},  # the last stamp again
        {"first_ticks": 102 * 1000},
        {"first_ticks": 100 * 1000 - 5000},
    ],
)
def test_a_record_whose_stamps_do_not_run_on_begins_a_window(change):
    ticks = [1000 * k for k in range(200)]
    earlier, later = record_of(ticks[:100], 0, 10), record_of(ticks[100:], 1000, 10)
    for second, held in ((later, 2), (later._replace(**change), 1)):
        assert windows().push(payload_of([earlier, second])).held == [[1], [held]]
