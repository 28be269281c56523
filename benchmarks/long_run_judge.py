"""What a long run asks of the daemon's memory, accounts and messages, for `long_run.py` and `year.py`."""

import json
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
HELD: Final = (  # name, key of a sample, largest rise
    ("memory in use, MB", "malloc_mb", FLAT_MB),
    ("Python's blocks in use, thousand", "blocks_thousand", FLAT_THOUSANDS),
    ("memory of the process, MB", "rss_mb", KEPT_MB),
    ("file descriptors", "file_descriptors", FLAT),
    ("threads", "threads", FLAT),
    ("tasks", "tasks", FLAT),
)


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


class Leg(NamedTuple):
    """One board from its start to its orderly end, as it and the daemon count it."""

    faults: str
    sent: int
    missing: int  # of the frames that were sent whole
    excused: int  # that may be: what was on its way when a connection ended


@dataclass
class Seen:
    """All that a run has seen; counts where a list would grow without end."""

    asked_s: float = 0.0
    ran_s: float = 0.0
    cut_short: bool = False
    samples: list[dict[str, float]] = field(default_factory=list)
    legs: list[Leg] = field(default_factory=list)
    healths: int = 0
    accounts_off: list[str] = field(default_factory=list)  # the first of them
    messages: int = 0
    holes: int = 0  # messages that are missing and that nothing told of
    out_of_order: int = 0
    tracebacks: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)  # what `status` did not answer
    asked: int = 0
    recording: dict[str, Any] = field(default_factory=dict)  # of the last `health`
    recordings_over_mb: float = 0.0  # the most above the budget
    exit_code: int | None = None


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
    known = ("acknowledged", "written", "unknown_at_disconnect", "waiting")
    came_to = sum(messages["dropped"].values()) + sum(messages[key] for key in known)
    if messages["enqueued"] != came_to:
        off.append(f"messages enqueued {messages['enqueued']}, accounted for {came_to}")
    return off


def leg_of(faults: str, board: Mapping[str, Any], before: Mapping[str, Any], after: Mapping[str, Any]) -> Leg:
    """Compare what a board sent with the difference of the daemon's `health` before and after."""
    stale = after["packets_ignored"].get("stale", 0) - before["packets_ignored"].get("stale", 0)
    hang_ups = after["connections"] - before["connections"]
    missing = board["frames_sent"] - board["faults"]["frames_hit"] - (after["frames"] - before["frames"])
    return Leg(faults, board["frames_sent"], missing, END_FRAMES * (hang_ups + 1) + stale)


def judge(seen: Seen) -> list[Row]:
    """Return the table of what was asked and what was seen."""
    cut = ", then cut short: what follows is of that time" if seen.cut_short else ""
    rows = [Row("time", f"{seen.asked_s / 60:.1f} min", f"{seen.ran_s / 60:.1f} min{cut}", not seen.cut_short)]
    begin_s = seen.samples[0]["at_s"] if seen.samples else 0.0
    warm_up_s = min(WARM_UP_MAX_S, WARM_UP_SHARE * (seen.samples[-1]["at_s"] - begin_s)) if seen.samples else 0.0
    later = [sample for sample in seen.samples if sample["at_s"] - begin_s >= warm_up_s]  # an allocator finds its size
    for what, key, flat in HELD:
        values, at_s = [sample[key] for sample in later], [sample["at_s"] for sample in later]
        if key in ("malloc_mb", "blocks_thousand"):  # the lowest of each few
            groups = [slice(n, n + LOWEST_OF) for n in range(0, len(values) - LOWEST_OF + 1, LOWEST_OF)]
            values, at_s = [min(values[each]) for each in groups], [float(np.mean(at_s[each])) for each in groups]
        rows.append(_slope_row(what, trend(at_s, values), flat))
    strange = [leg for leg in seen.legs if not -HEALED_FRAMES <= leg.missing <= leg.excused]
    sent, missing, excused = (sum(leg[n] for leg in seen.legs) for n in (1, 2, 3))
    legs = f"{missing} of {sent} in {len(seen.legs)} legs, at most {excused}"
    recording = seen.recording
    return [
        *rows,
        Row(
            "whole frames that did not arrive",
            "those on their way at hang-ups",
            f"{legs} {strange[:3]}",
            bool(seen.legs) and not strange,
        ),
        _list_row("accounts that do not balance", seen.accounts_off, f"{seen.healths} health messages", seen.healths),
        Row("messages missing without a word", "0", f"{seen.holes} of {seen.messages}", seen.holes == 0),
        Row("messages out of order", "0", str(seen.out_of_order), seen.out_of_order == 0),
        Row("tracebacks in the log", "0", f"{len(seen.tracebacks)} {seen.tracebacks[:1]}", not seen.tracebacks),
        _list_row("questions without an answer", seen.refused, f"{seen.asked} asked", seen.asked),
        Row("recordings above their budget", "0 MB", f"{seen.recordings_over_mb:.1f} MB", not seen.recordings_over_mb),
        Row(
            "old recordings removed", "some", f"{recording.get('files_removed')}", bool(recording.get("files_removed"))
        ),
        Row("events in no recording", "0", f"{recording.get('events_missing')}", recording.get("events_missing") == 0),
        Row("exit code on SIGTERM", "0", str(seen.exit_code), seen.exit_code == 0),
    ]


def print_rows(rows: Sequence[Row], *, as_json: bool) -> int:
    """Print the table, or one object; return the exit code."""
    if as_json:
        print(json.dumps({"rows": [row._asdict() for row in rows]}))
    for row in () if as_json else rows:
        print(f"{'ok  ' if row.good else 'MISS'} {row.what}: required {row.asked}; result {row.seen}")
    return int(not all(row.good for row in rows))


def _slope_row(what: str, found: Trend | None, flat: float) -> Row:
    asked = f"no rise beyond {CERTAIN:g} standard errors and {flat:g}"
    if found is None:
        return Row(what, asked, "too few samples", good=False)
    bound = max(0.0, found.per_hour + CERTAIN * found.std_per_hour)
    seen = f"{found.per_hour:+.2f} ± {found.std_per_hour:.2f} /h, {found.rise:+.2f} in all, up to {bound:.2f} /h unseen"
    return Row(what, asked, seen, not rises(found, flat))


def _list_row(what: str, wrong: Sequence[str], of: str, count: int) -> Row:
    """Nothing wrong is good only where there was something to look at."""
    return Row(
        what, "0", f"{len(wrong)} of {of}" + "".join(f"\n    {line}" for line in wrong[:20]), count > 0 and not wrong
    )
