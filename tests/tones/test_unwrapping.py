from fractions import Fraction

import numpy as np
import pytest
from brute_force_board import REFERENCE_HZ, WRAP, Channel, record_of

from firmware_protocol.layouts import RecordFlag
from resonator_daemon.tones.unwrapping import Stamp, Unwrapper, frequency_between_hz

UNIT = 1 << 32  # times are whole 2^-32 ticks, so that they are exact
STRIDE, STAMPS = 50_000, 12


class ExactBoard:
    """Edges of a tone whose period, a whole number of 2^-32 ticks, may change from frame to frame."""

    def __init__(self, edge, start_ticks):
        self.edge = edge
        self.time = start_ticks * UNIT + UNIT // 3

    def run(self, ticks, period):
        """Let whole edges pass until `ticks` later, without a record."""
        edges = ticks * UNIT // period
        self.edge += edges
        self.time += edges * period

    def frame(self, period):
        """Return the board's time, a record, and edge and time of its first and last stamp, exact."""
        times = [self.time + k * STRIDE * period for k in range(STAMPS)]
        ends = (self.edge, Fraction(times[0], UNIT)), (self.edge + (STAMPS - 1) * STRIDE, Fraction(times[-1], UNIT))
        record = record_of([time // UNIT for time in times], self.edge, STRIDE)
        self.edge += STAMPS * STRIDE
        self.time += STAMPS * STRIDE * period
        return self.time // UNIT, record, ends


def period_of(frequency_hz):
    return round(REFERENCE_HZ * UNIT / frequency_hz)


@pytest.mark.parametrize("start", [WRAP - 10**9, (1 << 40) - 10**9, (1 << 63) - 10**9, (1 << 64) - 10**9])
def test_thirty_days_stay_within_a_tick_of_exact_rationals(start):
    rng = np.random.default_rng(1)
    board, unwrapper = ExactBoard(WRAP - 12_345, start), Unwrapper()
    shift, first = 0.0, None
    day_ticks, origin = 86_400 * 10**9, board.time // UNIT
    while board.time // UNIT - origin < 30 * day_ticks:
        shift = np.clip(shift + rng.normal(0, 5e-6), -80e-6, 80e-6)
        period = period_of(9.9876e6 * (1 + shift))
        board_ticks, record, (earlier, later) = board.frame(period)
        assert unwrapper.push(board_ticks, record) is None
        first = first or earlier
        assert unwrapper.last.edge == later[0]
        assert 0 <= later[1] - unwrapper.last.ticks < 1
        # Frames are lost for up to half an hour: hundreds of wraps of ticks, several of edges.
        board.run(int(rng.exponential(4e11)) % (18 * 10**11), period)
    assert not unwrapper.resyncs
    exact_hz = float((later[0] - first[0]) / (later[1] - first[1]) * 10**9)
    found_hz = frequency_between_hz(unwrapper.first, unwrapper.last, REFERENCE_HZ)
    assert found_hz == pytest.approx(exact_hz, rel=1 / (30 * day_ticks))


def test_jitter_and_the_chirp_of_a_press_are_no_resync():
    rng = np.random.default_rng(2)
    channel, unwrapper, frequency = Channel(rng, 10, WRAP - 999, 0), Unwrapper(), 10e6
    for frame in range(1, 300):
        frequency *= 1 + 15e-6 * np.sign(np.sin(frame / 10))
        assert unwrapper.push(frame * 1_000_000, channel.gate(frequency, frame * 1_000_000)) is None


def test_ticks_that_are_longer_than_a_period_are_no_resync():
    """100 MHz counted in ticks of 16 ns: a tick of jitter is more than one edge."""
    rng = np.random.default_rng(3)
    unwrapper, interval, stamps = Unwrapper(), 62.5, 40
    for gate in range(300):
        times = interval * (gate * stamps + np.arange(stamps)) + rng.normal(0, 1, stamps)
        record = record_of(np.floor(times + 10).astype(np.int64).tolist(), gate * stamps * 100, 100)
        assert unwrapper.push(round((gate + 1) * stamps * interval) + 10, record) is None


def adjacent():
    board = ExactBoard(1000, 5)
    unwrapper = Unwrapper()
    frames = [board.frame(period_of(10e6))[:2] for _ in range(4)]
    for frame in frames[:2]:
        assert unwrapper.push(*frame) is None
    return unwrapper, frames[2], frames[3]


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"first_edge": 2}, "edges_implausible"),
        ({"first_edge": -2}, "edges_implausible"),
        ({"first_edge": 1 << 31}, "edges_implausible"),
        ({"first_edge": STRIDE}, "edges_implausible"),
        ({"first_ticks": 1000}, "edges_implausible"),
        ({"first_ticks": -1000}, "edges_implausible"),
        ({"first_ticks": -(1 << 28)}, "ticks_implausible"),  # before the last stamp
        ({"first_ticks": 11_000_000}, "ticks_implausible"),  # ends after the board's time
        ({"flags": RecordFlag.STRIDE_BREAK}, "stride_break"),
    ],
)
def test_a_step_that_no_tone_makes_starts_the_counts_anew(change, cause):
    unwrapper, (board_ticks, record), after = adjacent()
    changed = {name: (getattr(record, name) + value) % WRAP for name, value in change.items()}
    assert unwrapper.push(board_ticks, record._replace(**changed)) == cause
    assert unwrapper.resyncs == {cause: 1}
    assert unwrapper.first == Stamp(changed.get("first_edge", record.first_edge), unwrapper.first.ticks)
    assert unwrapper.last.edge - unwrapper.first.edge == (STAMPS - 1) * STRIDE
    # The next sound record is followed or starts anew; no frequency spans the step.
    unwrapper.push(*after)
    assert frequency_between_hz(unwrapper.first, unwrapper.last, REFERENCE_HZ) == pytest.approx(10e6, rel=1e-7)


def test_a_board_whose_time_goes_back_starts_the_counts_anew():
    unwrapper, frame, _ = adjacent()
    unwrapper.push(*frame)
    board = ExactBoard(0, 7)
    assert unwrapper.push(*board.frame(period_of(10e6))[:2]) == "ticks_implausible"


@pytest.mark.parametrize(("minutes", "cause"), [(30, None), (40, "gap_too_long")])
def test_a_gap_that_leaves_wraps_of_edges_in_doubt_starts_the_counts_anew(minutes, cause):
    board, unwrapper = ExactBoard(0, 7), Unwrapper()
    unwrapper.push(*board.frame(period_of(10e6))[:2])
    board.run(minutes * 60 * 10**9, period_of(10e6))
    assert unwrapper.push(*board.frame(period_of(10e6))[:2]) == cause


def test_restart_forgets_and_counts_once():
    unwrapper, frame, _ = adjacent()
    unwrapper.restart("no_signal")
    unwrapper.restart("no_signal")
    assert (unwrapper.first, unwrapper.last, unwrapper.resyncs) == (None, None, {"no_signal": 1})
    assert unwrapper.push(*frame) is None
    assert unwrapper.first.edge == frame[1].first_edge
