"""Latencies, and what is missing, from messages and a truth that the test makes; and how they are told."""

import json

import numpy as np

from resonator_daemon.demo.latency_report import Arrival, Gates, measure, read_gates
from resonator_daemon.monitoring.latency import BOUNDS_MS
from resonator_daemon.publishing.codec import encode
from resonator_daemon.publishing.payloads import Decoded, Lost

TICKS_PER_GATE = 250_000
GATE_NS = 1_000_000
START_NS = 1_789_000_000_000_000_000


def ends_ns(gate: int) -> int:
    return START_NS + gate * GATE_NS


def truth(count: int) -> Gates:
    lines = [
        json.dumps({"sequence": n, "board_ticks": 7 + n * TICKS_PER_GATE, "t_ns": str(ends_ns(n)), "contacts": []})
        for n in range(count)
    ]
    return read_gates(lines)


def message(seq: int, gate: int, late_ms: float) -> Arrival:
    payload = json.dumps({"seq": seq, "board_ticks": str(7 + gate * TICKS_PER_GATE), "sites": []}).encode()
    return Arrival(ends_ns(gate) + round(late_ms * 1e6), payload)


def test_a_latency_runs_from_the_end_of_the_last_gate_to_the_callback() -> None:
    arrivals = [message(seq, 4 + 5 * seq, late_ms) for seq, late_ms in enumerate((1.5, 30.0, 20.0, 2.5))]
    latency = measure(arrivals, truth(30), gates_apart=5)
    np.testing.assert_allclose(latency.milliseconds, [1.5, 30.0, 20.0, 2.5])
    assert (latency.late, latency.not_received, latency.not_made, latency.missing) == (1, 0, 0, 0)
    occupied = {bound_ms: count for bound_ms, count in zip(BOUNDS_MS, latency.counts(), strict=False) if count}
    assert occupied == {2.0: 1, 2.8: 1, 20.0: 1, 35.0: 1}
    assert sum(latency.counts()) == 4


def test_what_is_missing_was_lost_on_the_way_or_never_made() -> None:
    # Numbers 1 and 2 were made and did not come; of the gates 19 to 24 no message was made.
    arrivals = [message(0, 4, 1.0), message(3, 19, 1.0), message(4, 29, 1.0)]
    latency = measure(arrivals, truth(30), gates_apart=5)
    assert (latency.not_received, latency.not_made, latency.missing) == (2, 1, 3)


def test_arrays_are_read_from_their_beginning() -> None:
    array = np.zeros((3, 32, 32), np.float32)
    decoded = Decoded(
        seq=70_000,
        name="hand",
        daemon_boot_id="9f3c52d0",
        t_ns=2**63,
        t_uncertainty_ns=42_000,
        lost=Lost(link_gap=2**31),
        board_ticks=7 + 2 * TICKS_PER_GATE,
        traction_pascal=array,
        traction_std_pascal=array,
        displacement_m=array,
        grid=None,
    )
    latency = measure([Arrival(ends_ns(2) + 3_000_000, encode(decoded)[:512])], truth(3), gates_apart=1)
    np.testing.assert_allclose(latency.milliseconds, [3.0])
