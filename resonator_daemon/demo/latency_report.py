"""What a measurement of latency looks like: as JSON, as words with a histogram, and as a picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from resonator_daemon.demo.latency_figures import LATE_MS, Latency
from resonator_daemon.monitoring.latency import BOUNDS_MS
from resonator_daemon.publishing.topics import DECODED
from resonator_daemon.view.pages import make_figure

_BAR_COLUMNS: Final = 40
_EIGHTHS: Final = " ▏▎▍▌▋▊▉"


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
