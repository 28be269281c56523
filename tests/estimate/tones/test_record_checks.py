import math

import numpy as np
import pytest
from brute_force_board import REFERENCE_HZ, record_of

from firmware_protocol.layouts import RecordFlag, SingleToneRecord
from resonator_daemon.estimate.tones.frequency_estimators import Sums, frequency_hz
from resonator_daemon.estimate.tones.record_checks import FAULTS, read_gates

GOOD = record_of([1000 * k for k in range(1000)], 0, 10)


def gate_of(record, band_hz=(1e3, 1e9)):
    """Fault and frequency of one record."""
    (gate,) = read_gates([record], REFERENCE_HZ, band_hz)
    return (FAULTS[gate], math.nan) if isinstance(gate, int) else (None, gate[1])


def fault(record):
    return gate_of(record)[0]


@pytest.mark.parametrize("step", [900, 933, 999])
def test_a_gate_has_the_record_s_sums_their_frequency_and_the_residual_of_its_ends(step):
    ticks = [step * k + (k % 3 == 0) for k in range(77)]
    record = record_of(ticks, 4_294_967_000, 10)
    ((sums, hertz, residual_ticks2),) = read_gates([record], REFERENCE_HZ, (1e3, 1e9))
    assert sums == Sums.of(record)
    assert hertz == frequency_hz(Sums.of(record), REFERENCE_HZ)
    number = np.arange(77)
    off = ticks - np.polyval(np.polyfit(number, ticks, 1), number)
    assert residual_ticks2 == pytest.approx((off[0] ** 2 + off[-1] ** 2) / 2, rel=1e-6)


def test_a_frequency_that_the_plate_cannot_send_is_a_fault():
    assert gate_of(GOOD, (9e6, 11e6))[0] is None
    assert gate_of(GOOD, (10.1e6, 11e6))[0] == "impossible_frequency"
    assert gate_of(GOOD, (9e6, 9.9e6))[0] == "impossible_frequency"


def test_a_steady_tone_has_no_fault():
    assert fault(GOOD) is None
    assert fault(GOOD._replace(flags=int(RecordFlag.STRIDE_BREAK))) is None
    assert fault(record_of([0, 1000, 2001], 0, 10)) is None


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"flags": RecordFlag.NO_SIGNAL | RecordFlag.OVERFLOW}, "no_signal"),
        ({"flags": RecordFlag.OVERFLOW | RecordFlag.CAPTURE_SWITCH}, "overflow"),
        ({"flags": RecordFlag.CAPTURE_SWITCH | RecordFlag.LOST_EDGE | RecordFlag.STRIDE_BREAK}, "capture_switch"),
        ({"flags": RecordFlag.LOST_EDGE | RecordFlag.SATURATED}, "lost_edge"),
        ({"flags": RecordFlag.SATURATED}, "saturated"),
        ({"stamps": 1}, "impossible_counts"),
        ({"stamps": 2, "span_ticks": 1000, "s1_ticks": 1000, "s2_ticks": 1000}, "impossible_counts"),
        ({"stride_edges": 0}, "impossible_counts"),
        ({"span_ticks": 0, "s1_ticks": 0, "s2_ticks": 0}, "impossible_counts"),
        ({"span_ticks": 998}, "impossible_counts"),
        ({"s1_ticks": 0}, "impossible_counts"),
        ({"s1_ticks": GOOD.s1_ticks + (1 << 25)}, "impossible_counts"),
        ({"s1_ticks": (1 << 64) - 1}, "impossible_counts"),
        ({"s2_ticks": GOOD.s2_ticks - (1 << 34)}, "impossible_counts"),
        ({"s2_ticks": (1 << 64) - 1}, "impossible_counts"),
        (SingleToneRecord(*[0] * 10)._asdict(), "impossible_counts"),
        (SingleToneRecord(0, 0, 3, 1, 2, 3, 3, 0, 0, 0)._asdict(), "impossible_counts"),  # its slope is 0
    ],
)
def test_impossible_records_are_named(change, cause):
    assert fault(GOOD._replace(**change)) == cause


def test_faults_of_flags_have_the_names_of_the_wire_in_order_of_precedence():
    assert FAULTS[1:6] == tuple(RecordFlag(bit).name.lower() for bit in (0x10, 0x02, 0x08, 0x01, 0x04))


def test_sums_that_contradict_each_other_give_no_frequency() -> None:
    """A regression slope that leaves the end points' behind is damage that a checksum does not detect."""
    stamps = [1000 + 1001 * k // 10 * 10 for k in range(1000)]
    sound = record_of(stamps, 0, 10)
    assert fault(sound) is None
    for damage in (sound.s2_ticks // 20_000, -sound.s2_ticks // 20_000):
        assert fault(sound._replace(s2_ticks=sound.s2_ticks + damage)) == "impossible_counts"
    assert fault(sound._replace(q2_ticks2=2**64 - 1)) == "impossible_counts"


def test_stamps_that_scatter_by_more_than_their_distance_are_refused():
    # sqrt(2) s reaches the distance u of two stamps where Q2, 6 (N - 2) s^2, reaches 3 (N - 2) u^2.
    interval = GOOD.span_ticks / (GOOD.stamps - 1)
    limit_ticks2 = 3 * (GOOD.stamps - 2) * interval**2
    assert fault(GOOD._replace(q2_ticks2=int(1.01 * limit_ticks2))) == "impossible_counts"
    assert fault(GOOD._replace(q2_ticks2=int(0.99 * limit_ticks2))) is None
    # Every second stamp is late by a tenth: the end points alone are off by 0.26 %, within the noise of the stamps.
    assert fault(record_of([1000 * k + 100 * (k % 2) for k in range(40)], 0, 10)) is None
