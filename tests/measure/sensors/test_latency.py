"""Histograms of latency: which bin a duration falls into, and from when to when it is counted."""

from types import SimpleNamespace

import pytest

from resonator_daemon.board.session.clock import Instant
from resonator_daemon.measure.sensors import output as latency
from resonator_daemon.measure.sensors.output import Latencies, LatencyHistogram
from resonator_daemon.mqtt.topics import DECODED, FORCES


def bins(histogram: LatencyHistogram) -> dict[float | None, int]:
    info = histogram.info()
    assert len(info.counts) == len(info.bounds_ms) + 1
    return {bound: count for bound, count in zip((*info.bounds_ms, None), info.counts, strict=True) if count}


@pytest.mark.parametrize(
    ("milliseconds", "bound_ms"),
    [(-0.1, 0.25), (0.25, 0.25), (0.26, 0.35), (1.999, 2.0), (2.0, 2.0), (2.001, 2.8), (999.0, 1000.0), (1001.0, None)],
)
def test_a_bin_holds_what_lies_below_its_bound(milliseconds: float, bound_ms: float | None) -> None:
    histogram = LatencyHistogram()
    histogram.add(milliseconds / 1000)
    assert bins(histogram) == {bound_ms: 1}


def test_a_message_is_as_old_as_the_end_of_its_last_gate(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = 5_000_000_000
    monkeypatch.setattr(latency, "monotonic_ns", lambda: now_ns)
    latencies = Latencies(gate_s=0.01)
    clocks = SimpleNamespace(middle=lambda ago_ms: Instant(0, 0, monotonic_ns=now_ns - round(ago_ms * 1e6)))
    latencies.count(FORCES, clocks.middle(ago_ms=5.0 + 1.3))
    latencies.count(FORCES, clocks.middle(ago_ms=5.0 + 1.3))
    latencies.count(DECODED, clocks.middle(ago_ms=5.0 + 7.0))
    told = latencies.info()
    assert set(told) == {"forces", "decoded"}
    by_bound = {path: dict(zip(info.bounds_ms, info.counts, strict=False)) for path, info in told.items()}
    assert by_bound["forces"][1.4] == 2 == sum(told["forces"].counts)
    assert by_bound["decoded"][8.0] == 1 == sum(told["decoded"].counts)
