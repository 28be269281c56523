"""Parts of pages: quantities as text, with units and "-" for unknown ones, and tables of numbers."""

import math
from collections.abc import Mapping
from typing import Final

from rich.table import Table

UNKNOWN: Final = "-"


def quantity(value: float | None, form: str, unit: str) -> str:
    """Return a value in the format `form`, with its unit."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    return f"{value:{form}}{unit}"


def newtons(force_newton: float | None) -> str:
    """Return a force in N, a small one in mN."""
    if force_newton is not None and abs(force_newton) < 1:
        return quantity(1e3 * force_newton, ".1f", " mN")
    return quantity(force_newton, ".3f", " N")


def millinewtons(force_newton: float) -> str:
    """Return an uncertainty as a bare number of mN."""
    return quantity(1e3 * force_newton, ".1f" if force_newton < 10e-3 else ".0f", "")


def duration(seconds: float) -> str:
    if not math.isfinite(seconds):
        return UNKNOWN
    if seconds < 60:
        return f"{max(seconds, 0.0):.1f} s"
    minutes, left_s = divmod(int(seconds), 60)
    return f"{minutes} min {left_s} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


_NOT_FRAMES: Final = {
    "skipped_late": "messages skipped as late",
    "publish_dropped": "messages dropped before the broker",
    "parts": "parts of frames missing",
    "not_decoded": "frames not decoded",
}


def losses_in_words(counts: Mapping[str, int]) -> str:
    """Return how many frames were lost by which cause, and what else was left out."""
    if not any(counts.values()):
        return "nothing lost"
    frames = [
        f"{cause.replace('_', ' ')} {count}" for cause, count in counts.items() if count and cause not in _NOT_FRAMES
    ]
    others = [f"{counts[cause]} {what}" for cause, what in _NOT_FRAMES.items() if counts.get(cause)]
    return "; ".join([f"frames lost: {', '.join(frames)}" if frames else "no frame lost", *others])


def number_table(first: str, *others: str) -> Table:
    """Return a table without lines, numbers at the right of each column but the first."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(first, overflow="fold")
    for name in others:
        table.add_column(name, justify="right", overflow="fold")
    return table
