"""What a long run asks of the daemon, as pure functions of what was seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

WARM_UP_SHARE: Final = 0.25  # of the run, and at most:
WARM_UP_MAX_S: Final = 3600.0
CERTAIN: Final = 3.0  # standard errors: one run in 700 without a leak would be told of one
# Rises over the whole run that are no leak: what is on its way at one moment and not at another.
FLAT_MB: Final = 0.3
FLAT_THOUSANDS: Final = 3.0  # of blocks
FLAT: Final = 0.5
KEPT_MB: Final = 10.0  # of the process: the allocator keeps what the highest peak took, and holes between what stays
LOWEST_OF: Final = 4  # samples: what is on its way only adds to what stays
END_FRAMES: Final = 350  # on their way when a board goes: a pseudo-terminal's buffer, as far as 64 kB
HEALED_FRAMES: Final = 3  # per leg: two damaged frames may leave one whole


class Row(NamedTuple):
    """One line of the table."""

    what: str
    asked: str
    seen: str
    good: bool


class Trend(NamedTuple):
    """How a quantity went: slope an hour, its standard error, and the rise over the whole time."""

    per_hour: float
    std_per_hour: float
    rise: float


@dataclass
class Sample:
    """What the daemon held at one moment."""

    at_s: float
    rss_mb: float
    malloc_mb: float  # in use
    python_blocks: float  # in use; of memory that malloc does not see
    file_descriptors: float
    threads: float
    tasks: float
    recordings_mb: float


@dataclass
class Leg:
    """One board from its start to its orderly end, planned or not, as it and the daemon count it."""

    faults: str
    sent: int
    hit: int
    hang_ups: int  # whatever ends a connection
    arrived: int
    stale: int  # packets that the daemon passed over after a hang-up

    @property
    def missing(self) -> int:
        """Frames that the board sent whole, and that did not arrive."""
        return self.sent - self.hit - self.arrived

    @property
    def excused(self) -> int:
        """How many may be: what was on its way when a connection ended."""
        return END_FRAMES * (self.hang_ups + 1) + self.stale


@dataclass
class Seen:
    """All that a run has seen; counts where a list would grow without end."""

    asked_s: float = 0.0
    ran_s: float = 0.0
    cut_short: bool = False
    samples: list[Sample] = field(default_factory=list)
    legs: list[Leg] = field(default_factory=list)
    healths: int = 0
    accounts_off: list[str] = field(default_factory=list)  # the first of them
    messages: int = 0
    holes: int = 0  # messages that are missing and that nothing told of
    holes_excused: int = 0
    out_of_order: int = 0
    lines: int = 0
    loaded_s: float = 0.0  # while other programs kept the cores busy, which explains some lines
    unexplained: list[str] = field(default_factory=list)
    events_missing: int = 0  # pieces of the link's traffic that are in no recording
    files: int = 0
    files_removed: int = 0
    recordings_over_mb: float = 0.0  # the most above the budget
    refused: list[str] = field(default_factory=list)  # what `status`, metrics or commands did not answer
    asked: int = 0
    exit_code: int | None = None
    spooled_at_end: int = 0


def warm(samples: Sequence[Sample]) -> list[Sample]:
    """Return those after the warm-up: tables fill, an allocator finds its size."""
    if not samples:
        return []
    begin_s = samples[0].at_s
    warm_up_s = min(WARM_UP_MAX_S, WARM_UP_SHARE * (samples[-1].at_s - begin_s))
    return [sample for sample in samples if sample.at_s - begin_s >= warm_up_s]


def lowest(at_s: Sequence[float], values: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return the lowest of each few values, and the times of these few in the mean; those left over are left out."""
    groups = [slice(n, n + LOWEST_OF) for n in range(0, len(values) - LOWEST_OF + 1, LOWEST_OF)]
    return [sum(at_s[group]) / LOWEST_OF for group in groups], [min(values[group]) for group in groups]


def trend(at_s: Sequence[float], values: Sequence[float]) -> Trend | None:
    """Fit a line by least squares; None for fewer than five values.

    The standard error counts with residuals that follow each other, as those of memory do: their correlation r from one
    to the next leaves n (1 - r) / (1 + r) independent ones of n.
    """
    if len(values) < 5:
        return None
    hours, y = np.asarray(at_s) / 3600.0, np.asarray(values, dtype=float)
    x = hours - hours.mean()
    slope = float(x @ y / (x @ x))
    residuals = y - y.mean() - slope * x
    power = float(residuals @ residuals)
    correlation = max(0.0, float(residuals[1:] @ residuals[:-1]) / power) if power > 1e-12 else 0.0
    correlation = min(correlation, 0.95)
    variance = power / (len(y) - 2) / float(x @ x) * (1 + correlation) / (1 - correlation)
    return Trend(slope, float(np.sqrt(variance)), slope * float(hours[-1] - hours[0]))


def rises(found: Trend, flat: float) -> bool:
    """Whether a quantity certainly grows, and by more than `flat` over the whole run."""
    return found.per_hour > CERTAIN * found.std_per_hour and found.rise > flat


def account_off(health: Mapping[str, Any]) -> list[str]:
    """Return which accounts of a message of `health` do not balance."""
    off = []
    fates = sum(health["bytes_by_outcome"].values())
    if health["bytes_in"] != fates:
        off.append(f"bytes_in {health['bytes_in']}, their fates {fates}")
    messages = health["messages"]
    came_to = (
        messages["acknowledged"]
        + messages["written"]
        + sum(messages["dropped"].values())
        + messages["unknown_at_disconnect"]
        + messages["waiting"]
    )
    if messages["enqueued"] != came_to:
        off.append(f"messages enqueued {messages['enqueued']}, accounted for {came_to}")
    return off


def leg_of(faults: str, board: Mapping[str, Any], before: Mapping[str, Any], after: Mapping[str, Any]) -> Leg:
    """Return what a board sent, and the difference of the daemon's `health` before and after."""
    done = board["faults"]
    stale = after["packets_ignored"].get("stale", 0) - before["packets_ignored"].get("stale", 0)
    return Leg(
        faults,
        board["frames_sent"],
        done["frames_hit"],
        after["connections"] - before["connections"],
        after["frames"] - before["frames"],
        stale,
    )


def judge(seen: Seen) -> list[Row]:
    """Return the table of what was asked and what was seen."""
    later = warm(seen.samples)
    at_s = [sample.at_s for sample in later]
    cut = ", then cut short: what follows is of that time" if seen.cut_short else ""
    rows = [Row("time", f"{seen.asked_s / 60:.1f} min", f"{seen.ran_s / 60:.1f} min{cut}", not seen.cut_short)]
    used = (
        ("memory in use", "MB", [sample.malloc_mb for sample in later], FLAT_MB),
        ("Python's blocks in use", "thousand", [sample.python_blocks / 1e3 for sample in later], FLAT_THOUSANDS),
    )
    for what, unit, values, flat in used:
        rows.append(_slope_row(what, unit, trend(*lowest(at_s, values)), flat))
    held = (
        ("memory of the process", "MB", [sample.rss_mb for sample in later], KEPT_MB),
        ("file descriptors", "", [sample.file_descriptors for sample in later], FLAT),
        ("threads", "", [sample.threads for sample in later], FLAT),
        ("tasks", "", [sample.tasks for sample in later], FLAT),
    )
    for what, unit, values, flat in held:
        rows.append(_slope_row(what, unit, trend(at_s, values), flat))
    strange = [leg for leg in seen.legs if not -HEALED_FRAMES <= leg.missing <= leg.excused]
    missing = sum(leg.missing for leg in seen.legs)
    excused = sum(leg.excused for leg in seen.legs)
    sent = sum(leg.sent for leg in seen.legs)
    legs = "; ".join(f"{leg.missing} missing of {leg.sent} ({leg.faults})" for leg in strange[:3])
    lines = f"{seen.lines} lines; the cores were busy for {seen.loaded_s:.0f} s"
    rows += [
        Row(
            "whole frames that did not arrive",
            "those on their way at hang-ups",
            f"{missing} of {sent} in {len(seen.legs)} legs, at most {excused}" + (f": {legs}" if legs else ""),
            bool(seen.legs) and not strange,
        ),
        _list_row("accounts that do not balance", seen.accounts_off, f"{seen.healths} health messages", seen.healths),
        Row("messages missing without a word", "0", f"{seen.holes} of {seen.messages}", seen.holes == 0),
        Row("messages out of order", "0", str(seen.out_of_order), seen.out_of_order == 0),
        _list_row("log lines that nothing explains", seen.unexplained, lines, seen.lines),
        _list_row("questions without an answer", seen.refused, f"{seen.asked} asked", seen.asked),
        Row("recordings above their budget", "0 MB", f"{seen.recordings_over_mb:.1f} MB", not seen.recordings_over_mb),
        Row("old recordings removed", "some", f"{seen.files_removed} of {seen.files} files", seen.files_removed > 0),
        Row("pieces in no recording", "0", str(seen.events_missing), seen.events_missing == 0),
        Row("exit code on SIGTERM", "0", str(seen.exit_code), seen.exit_code == 0),
    ]
    return rows


def _slope_row(what: str, unit: str, found: Trend | None, flat: float) -> Row:
    asked = f"no rise beyond {CERTAIN:g} standard errors and {flat:g} {unit}".rstrip()
    if found is None:
        return Row(what, asked, "too few samples", good=False)
    bound = found.per_hour + CERTAIN * found.std_per_hour
    seen = (
        f"{found.per_hour:+.2f} ± {found.std_per_hour:.2f} {unit}/h, {found.rise:+.2f} in all; "
        f"a leak of {max(0.0, bound):.2f} {unit}/h would not be seen"
    )
    return Row(what, asked, seen, not rises(found, flat))


def _list_row(what: str, wrong: Sequence[str], of: str, count: int) -> Row:
    """Nothing wrong is good only where there was something to look at."""
    said = f"{len(wrong)} of {of}" + "".join(f"\n    {line}" for line in wrong[:20])
    return Row(what, "0", said, count > 0 and not wrong)
