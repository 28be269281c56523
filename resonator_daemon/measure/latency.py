"""How long after the end of its window a message goes to the publisher: histograms, counted as the messages pass."""

from bisect import bisect_left
from time import monotonic_ns
from typing import Any, Final

from resonator_daemon.board.session.clock import Instant
from resonator_daemon.mqtt.payloads import LatencyInfo
from resonator_daemon.mqtt.topics import Topic

# About three to an octave where a machine that keeps up is; limits of docs/explanation/performance.md are among them.
BOUNDS_MS: Final = (
    *(0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.0, 6.0, 8.0, 10.0, 14.0, 20.0, 25.0, 35.0, 50.0),
    *(70.0, 100.0, 200.0, 500.0, 1000.0),
)


class LatencyHistogram:
    """Counts durations by magnitude; a bin has all up to its bound, and its bound."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS_MS) + 1)

    def add(self, seconds: float) -> None:
        self._counts[bisect_left(BOUNDS_MS, 1e3 * seconds)] += 1

    def info(self) -> LatencyInfo:
        return LatencyInfo(bounds_ms=BOUNDS_MS, counts=tuple(self._counts))


class Latencies:
    """One histogram for each topic of a board whose gates are `gate_s` long."""

    def __init__(self, gate_s: float) -> None:
        self._half_a_gate_ns = round(gate_s / 2 * 1e9)
        self._histograms: dict[str, LatencyHistogram] = {}

    def count(self, topic: Topic[Any], gate_middle: Instant) -> None:
        """Count a message that goes to the publisher now; `gate_middle` is that of the last gate of its window."""
        waited_ns = monotonic_ns() - (gate_middle.monotonic_ns + self._half_a_gate_ns)
        histogram = self._histograms.get(topic.path)
        if histogram is None:
            histogram = self._histograms[topic.path] = LatencyHistogram()
        histogram.add(waited_ns * 1e-9)

    def info(self) -> dict[str, LatencyInfo]:
        """Return the histograms by topic, as `health` publishes them."""
        return {path: histogram.info() for path, histogram in self._histograms.items()}
