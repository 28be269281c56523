import pytest
from brute_force_board import REFERENCE_HZ, record_of

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.measurement.counting import Sums, frequency_hz
from resonator_daemon.measurement.record_faults import Gate, read_gate

GOOD = record_of([1000 * k for k in range(1000)], 0, 10)


def fault(record):
    gate = read_gate(record, REFERENCE_HZ)
    return None if isinstance(gate, Gate) else gate


def test_a_gate_has_the_record_s_sums_and_their_frequency():
    for step in range(900, 1000):
        stamps = [step * k + (k % 3 == 0) for k in range(77)]
        record = record_of(stamps, 4_294_967_000, 10)
        gate = read_gate(record, REFERENCE_HZ)
        assert gate.sums == Sums.of(record)
        assert gate.frequency_hz == frequency_hz(Sums.of(record), REFERENCE_HZ)


def test_a_gate_has_what_the_line_leaves_of_its_ends():
    # The line through 0, 1000, 2000, 3004 at 0, 1, 2, 3 is -0.8 + 1001.2 k.
    residual_ticks2 = read_gate(record_of([0, 1000, 2000, 3004], 0, 10), REFERENCE_HZ).residual_ticks2
    assert residual_ticks2 == pytest.approx((0.8**2 + 1.2**2) / 2)
    assert read_gate(GOOD, REFERENCE_HZ).residual_ticks2 == pytest.approx(0.0, abs=1e-12)


def test_a_steady_tone_has_no_fault():
    assert fault(GOOD) is None
    assert fault(GOOD._replace(flags=int(RecordFlag.STRIDE_BREAK))) is None
    assert fault(record_of([0, 1000, 2001], 0, 10)) is None


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"flags": RecordFlag.NO_SIGNAL}, "no_signal"),
        ({"flags": RecordFlag.OVERFLOW}, "overflow"),
        ({"flags": RecordFlag.CAPTURE_SWITCH | RecordFlag.STRIDE_BREAK}, "capture_switch"),
        ({"flags": RecordFlag.LOST_EDGE}, "lost_edge"),
        ({"flags": RecordFlag.SATURATED}, "saturated"),
        ({"stamps": 0}, "impossible_counts"),
        ({"stamps": 1}, "impossible_counts"),
        ({"stamps": 2, "span_ticks": 1000, "s1_ticks": 1000, "s2_ticks": 1000}, "impossible_counts"),
        ({"stride_edges": 0}, "impossible_counts"),
        ({"span_ticks": 0}, "impossible_counts"),
        ({"span_ticks": 0, "s1_ticks": 0, "s2_ticks": 0}, "impossible_counts"),
        ({"span_ticks": 998}, "impossible_counts"),
        ({"s1_ticks": 0}, "impossible_counts"),
        ({"s1_ticks": GOOD.s1_ticks + (1 << 25)}, "impossible_counts"),
        ({"s1_ticks": (1 << 64) - 1}, "impossible_counts"),
        ({"s2_ticks": 0}, "impossible_counts"),
        ({"s2_ticks": GOOD.s2_ticks - (1 << 34)}, "impossible_counts"),
        ({"s2_ticks": (1 << 64) - 1}, "impossible_counts"),
    ],
)
def test_impossible_records_are_named(change, cause):
    assert fault(GOOD._replace(**change)) == cause


def test_sums_that_contradict_each_other_give_no_frequency() -> None:
    """A regression slope that leaves the end points' behind is damage that a check sum cannot see."""
    stamps = [1000 + 1001 * k // 10 * 10 for k in range(1000)]
    offsets = [stamp - stamps[0] for stamp in stamps]
    second = [offsets[k] - 2 * offsets[k - 1] + offsets[k - 2] for k in range(2, 1000)]
    s2 = sum(k * offset for k, offset in enumerate(offsets))
    sound = SingleToneRecord(
        0, 1000, 1000, 10, offsets[-1], sum(offsets), s2, sum(value * value for value in second), 0, 0
    )
    assert fault(sound) is None
    assert fault(sound._replace(s2_ticks=s2 + s2 // 20_000)) == "impossible_counts"
    assert fault(sound._replace(s2_ticks=s2 - s2 // 20_000)) == "impossible_counts"
    assert fault(sound._replace(q2_ticks2=2**64 - 1)) == "impossible_counts"


def test_a_slope_of_nothing_is_no_frequency() -> None:
    assert fault(SingleToneRecord(0, 0, 3, 1, 2, 3, 3, 0, 0, 0)) == "impossible_counts"


def test_stamps_that_scatter_by_more_than_their_distance_are_refused():
    # sqrt(2) s reaches the distance u of two stamps where Q2, 6 (N - 2) s^2, reaches 3 (N - 2) u^2.
    interval = GOOD.span_ticks / (GOOD.stamps - 1)
    limit_ticks2 = 3 * (GOOD.stamps - 2) * interval**2
    assert read_gate(GOOD._replace(q2_ticks2=int(1.01 * limit_ticks2)), REFERENCE_HZ) == "impossible_counts"
    assert read_gate(GOOD._replace(q2_ticks2=int(0.99 * limit_ticks2)), REFERENCE_HZ) != "impossible_counts"
