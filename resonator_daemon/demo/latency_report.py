"""Latencies by messages and the truth, and the report of them: as JSON, as words with a histogram, and as a picture."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import cbor2
import numpy as np
from numpy.typing import NDArray

from resonator_daemon.monitoring.latency import BOUNDS_MS
from resonator_daemon.publishing.topics import DECODED
from resonator_daemon.view.pages import make_figure

_BAR_COLUMNS: Final = 40
_EIGHTHS: Final = " ▏▎▍▌▋▊▉"

LATE_MS: Final = 20.0

Int64s = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message as the subscriber's callback had it."""

    t_ns: int  # UTC
    head: bytes  # of a long one the beginning, behind `board_ticks` somewhere


@dataclass(frozen=True, slots=True)
class Gates:
    """All gates that the board counted: when each ended, by its clock and by UTC; both rise."""

    board_ticks: Int64s
    end_ns: Int64s


@dataclass(frozen=True, slots=True)
class Latency:
    """What a run amounts to."""

    milliseconds: NDArray[np.float64]  # of each message, from the end of the last gate to the callback
    not_received: int  # gaps in seq: lost on the way; of a decoder process, which copies seq, also what it skipped
    not_made: int  # windows of which no message was made: frames were lost, or skipped by the daemon's own decoder

    @property
    def missing(self) -> int:
        return self.not_received + self.not_made

    @property
    def late(self) -> int:
        return int(np.count_nonzero(self.milliseconds > LATE_MS))

    def counts(self) -> tuple[int, ...]:
        """Return the messages in each bin of the daemon's own histogram."""
        bins = np.searchsorted(BOUNDS_MS, self.milliseconds)
        return tuple(np.bincount(bins, minlength=len(BOUNDS_MS) + 1).tolist())


def read_gates(truth: Iterable[str]) -> Gates:
    """Read the lines of a truth file."""
    ends = [(line["board_ticks"], int(line["t_ns"])) for line in map(json.loads, truth)]
    ticks, ends_ns = np.array(ends, np.int64).reshape(-1, 2).T
    return Gates(ticks, ends_ns)


def measure(arrivals: Sequence[Arrival], gates: Gates, gates_apart: int) -> Latency:
    """Match messages with the gates that they describe.

    Parameters
    ----------
    arrivals
        Of one topic and one run of the daemon, in the order in which they came.
    gates
        Of the board.
    gates_apart
        From one message to the next, where nothing is missing.

    Raises
    ------
    ValueError
        Nothing arrived, or a message describes a gate that the truth does not have.
    """
    if not arrivals:
        raise ValueError("no arrivals: there is nothing to measure")
    seq, ticks = np.array([_seq_and_ticks(arrival.head) for arrival in arrivals], np.int64).T
    last_gate = np.minimum(np.searchsorted(gates.board_ticks, ticks), len(gates.board_ticks) - 1)
    if unknown := np.count_nonzero(gates.board_ticks[last_gate] != ticks):
        raise ValueError(f"{unknown} of {len(arrivals)} messages describe gates that the truth does not have")
    came_ns = np.array([arrival.t_ns for arrival in arrivals], np.int64)
    windows = (last_gate[-1] - last_gate[0]) // gates_apart + 1
    made = int(seq[-1] - seq[0]) + 1
    return Latency((came_ns - gates.end_ns[last_gate]) * 1e-6, made - len(arrivals), int(windows) - made)


def _seq_and_ticks(head: bytes) -> tuple[int, int]:
    """Read JSON, which is whole, or CBOR, which may be cut off."""
    if head.startswith(b"{"):
        message = json.loads(head)
        return message["seq"], int(message["board_ticks"])
    decoder = cbor2.CBORDecoder(BytesIO(head[1:]))  # behind the head of a map of up to 23 pairs of key and value
    found: dict[str, Any] = {}
    while "board_ticks" not in found:
        key = decoder.decode()
        found[key] = decoder.decode()
    return found["seq"], found["board_ticks"]


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """Result of one run, as JSON, text and picture.

    Attributes
    ----------
    daemon_counts
        The daemon's own histogram of the same time, up to where a message goes to the publisher; None where another
        process decodes.
    cpu_percent_by_part
        100 is one processor.
    load_average
        Of the whole computer over the last minute, with the parts of the measurement: about 1 if nothing else runs.
    """

    plate: str
    topic: str
    external: bool
    broker: str
    seconds: float
    latency: Latency
    daemon_counts: tuple[int, ...] | None
    cpu_percent_by_part: dict[str, float]
    load_average: float

    def as_json(self) -> dict[str, Any]:
        latency = self.latency
        return {
            "plate": self.plate,
            "topic": self.topic,
            "external": self.external,
            "broker": self.broker,
            "seconds": round(self.seconds, 3),
            "latency_ms": {
                "p50": self._quantile_ms(0.5),
                "p90": self._quantile_ms(0.9),
                "p99": self._quantile_ms(0.99),
                "max": self._quantile_ms(1.0),
            },
            "count": len(latency.milliseconds),
            "missing": latency.missing,
            "unheard": latency.not_received,
            "not_made": latency.not_made,
            f"over_{LATE_MS:g}_ms": latency.late,
            "histogram": {
                "bounds_ms": BOUNDS_MS,
                "subscriber": latency.counts(),
                "daemon": self.daemon_counts,
            },
            "cpu_percent_by_part": self.cpu_percent_by_part,
            "load_average": round(self.load_average, 2),
        }

    def in_words(self) -> str:
        latency = self.latency
        decoded = ", decoded in a process of its own" if self.external else ""
        unheard = "skipped by the decoder or lost on the way" if self.topic == DECODED.path else "lost on the way"
        lines = [
            f"{self.plate}, {self.topic}{decoded}: {self.seconds:.1f} s, broker {self.broker}",
            f"p50 {self._quantile_ms(0.5):g} ms, p99 {self._quantile_ms(0.99):g} ms, max {self._quantile_ms(1.0):g} ms "
            f"from the end of the last gate to the subscriber's callback",
            f"{len(latency.milliseconds)} messages, {latency.late} over {LATE_MS:g} ms, {latency.missing} missing "
            f"({latency.not_received} {unheard}, {latency.not_made} not made)",
            "",
            *_histogram(latency.counts(), self.daemon_counts),
            "",
            "% of a processor: " + ", ".join(f"{part} {value:g}" for part, value in self.cpu_percent_by_part.items()),
            f"load of the machine: {self.load_average:.1f}",
        ]
        return "\n".join(lines) + "\n"

    def write_picture(self, path: Path) -> None:
        """Draw how many messages came later than a given time; its suffix chooses .svg, .png or .pdf.

        Raises
        ------
        UserError
            matplotlib is not installed.
        """
        came_ms = np.sort(self.latency.milliseconds)
        later = 1.0 - np.arange(len(came_ms)) / len(came_ms)
        figure = make_figure((6.0, 3.6))
        axes = figure.subplots()
        axes.step(came_ms, later, where="post", color="black", label="subscriber")
        if self.daemon_counts is not None:
            within = np.cumsum(self.daemon_counts)
            later = 1.0 - within[:-1] / within[-1]
            axes.plot(BOUNDS_MS, np.where(later > 0, later, np.nan), "o", color="grey", label="daemon's histogram")
        axes.axvline(LATE_MS, color="grey", linestyle=":")
        axes.set(xscale="log", yscale="log", xlabel="ms from the end of the last gate", ylabel="share that came later")
        axes.set_title(f"{self.plate}, {self.topic}: {len(came_ms)} messages", fontsize="medium")
        axes.legend()
        figure.savefig(path)

    def _quantile_ms(self, q: float) -> float:
        return round(float(np.quantile(self.latency.milliseconds, q)), 3)


def _histogram(counts: Sequence[int], daemon_counts: Sequence[int] | None) -> list[str]:
    """Draw the bins from the first to the last that has something; the bars are the subscriber's."""
    own_counts = daemon_counts or [0] * len(counts)
    occupied = [n for n, both in enumerate(zip(counts, own_counts, strict=True)) if any(both)]
    head = f"{'':>12} {'subscriber':>10}  {'':{_BAR_COLUMNS}}" + (f" {'daemon':>8}" if daemon_counts else "")
    lines = [head.rstrip()]
    for n in range(occupied[0], occupied[-1] + 1):
        bound = f"<= {BOUNDS_MS[n]:g} ms" if n < len(BOUNDS_MS) else f"> {BOUNDS_MS[-1]:g} ms"
        eighths = math.ceil(8 * _BAR_COLUMNS * counts[n] / max(counts))
        bar = ("█" * (eighths // 8) + _EIGHTHS[eighths % 8]).rstrip()
        own = f" {own_counts[n]:8}" if daemon_counts else ""
        lines.append(f"{bound:>12} {counts[n]:10}  {bar:{_BAR_COLUMNS}}{own}".rstrip())
    return lines
