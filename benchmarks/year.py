"""A simulated year of a daemon and its board, in one table: accounts, events, times, memory.

Run it with `make soak`, or `python benchmarks/year.py [--days 365] [--seed 1] [--svg FILE] [--json]`. Exit code 1 when
a criterion failed.
"""

import argparse
import asyncio
import json
import logging
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from long_run_judge import FLAT, FLAT_THOUSANDS, KEPT_MB, Row, rises, trend
from simulated_disk import small_disk
from simulated_year import Sample, Year, simulate

_KEPT_THOUSANDS = 0.03  # a day: the samples and events of this benchmark
_SLOPES = (("rss_mb", "MB", KEPT_MB), ("blocks_thousand", "thousand blocks", FLAT_THOUSANDS), ("descriptors", "", FLAT))
# Counts of bytes begin below 2^53 and may exceed it, as docs/explanation/long-life.md describes.
_BYTES = ("health.bytes_in", "health.bytes_by_outcome.accepted")


def judge(year: Year) -> list[Row]:
    """Return the table."""
    seen = year.seen
    delivered = list(seen.events.values())
    late = _days_expired(year)
    inexact = {key: count for key, count in seen.inexact.items() if key not in _BYTES}
    rows = [
        Row(
            "frames, bytes, messages and recorded events of each run",
            "delivered + lost by cause = sent",
            f"{year.frames} delivered, {year.frames_lost} lost; {_first(seen.unbalanced)}",
            not seen.unbalanced,
        ),
        Row(
            "touches",
            "one onset, one release",
            f"{year.touches} touches; {_first(year.touches_wrong)}",
            year.touches > 0 and not year.touches_wrong,
        ),
        Row(
            "events on their way, through the spool",
            f"{seen.events_published} once each",
            f"{len(delivered)} events, {sum(delivered)} times",
            len(delivered) == sum(delivered) == seen.events_published,
        ),
        Row("t_ns", "back only by a set clock or its uncertainty", _first(seen.backwards), not seen.backwards),
        Row(
            "calibration expires", "once, the day after its expiry", ", ".join(year.expired_on), late == year.expired_on
        ),
        Row(
            "compensation while frames come",
            "each second, also when the clock is set",
            f"{year.compensation_missing} touches without it",
            not year.compensation_missing,
        ),
        Row("integers of JSON but bytes", "at most 2^53", str(inexact or "all"), not inexact),
        Row(
            "replay from a snapshot",
            "the same frames and times",
            f"{seen.replay_differs} of {seen.replayed} differ",
            not seen.replay_differs,
        ),
        Row(
            "frame numbers pass 2^32",
            "once, no frame lost by it",
            f"{year.numbers_past_2_32} times; {_first(year.numbers_wrong)}",
            year.numbers_past_2_32 == 1 and not year.numbers_wrong,
        ),
    ]
    if year.disk_can_fill:
        full = year.done.get("disk full", 0)
        rows.append(
            Row(
                "full disks, then emptied",
                "spool and recorder report each once, then continue; no event dropped",
                f"{full} times; {_first(year.disk_wrong)}",
                full > 0 and not year.disk_wrong,
            )
        )
    return rows + [row for name, unit, flat in _SLOPES if (row := _slope(year.samples, name, unit, flat)) is not None]


def _days_expired(year: Year) -> list[str]:
    """Return the days on which the calibration must expire: the first after its expiry date."""
    return [str(np.datetime64(year.expiry) + 1)]


def _first(wrong: list[str]) -> str:
    return f"{len(wrong)} wrong: {wrong[0]}" if wrong else "nothing wrong"


def _slope(samples: list[Sample], name: str, unit: str, flat: float) -> Row | None:
    warm = samples[len(samples) // 4 :]
    found = trend([3600.0 * sample.day for sample in warm], [getattr(sample, name) for sample in warm])
    if found is None:
        return None
    if name == "blocks_thousand":
        flat += _KEPT_THOUSANDS * len(warm)
    asked = f"no slope, or below {flat:g} {unit} in all"
    seen = f"{found.per_hour:+.2g} ± {found.std_per_hour:.2g} {unit} a day, {found.rise:+.2f} in all"
    return Row(name, asked, seen, not rises(found, flat))


def draw(samples: list[Sample], file: Path) -> None:
    """Draw memory, descriptors and losses over the days, from zero, so that a slope has its size."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    curves = {
        "memory, MB": [sample.rss_mb for sample in samples],
        "descriptors": [sample.descriptors for sample in samples],
        "frames lost in a day,\nmillion": np.diff([0.0, *(sample.frames_lost / 1e6 for sample in samples)]),
    }
    for axes, (label, values) in zip(figure.subplots(len(curves), 1, sharex=True), curves.items(), strict=True):
        axes.plot([sample.day for sample in samples], values)
        axes.set_ylabel(label)
        axes.set_ylim(0.0, 1.1 * max(values))
        axes.grid(alpha=0.3)
    axes.set_xlabel("day")
    figure.savefig(file)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--days", type=int, default=365)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--svg", type=Path, help="picture of memory, descriptors and losses")
    parser.add_argument("--json", action="store_true", help="the table as one object")
    options = parser.parse_args()
    logging.getLogger("resonator_daemon").propagate = False  # faults are asked for
    logging.getLogger("resonator_daemon").addHandler(logging.NullHandler())
    begun_s = time.monotonic()

    def report(text: str) -> None:
        print(f"{time.monotonic() - begun_s:7.1f} s  {text}", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as folder, small_disk(Path(folder)) as disk:
        if not disk.can_fill:
            report("full disks: skipped, as mounting one needs root")
        year = asyncio.run(simulate(options.days, options.seed, disk, report))
    rows = judge(year)
    if options.svg is not None:
        draw(year.samples, options.svg)
    if options.json:
        print(json.dumps({"rows": [row._asdict() for row in rows], "done": year.done}))
    else:
        print(", ".join(f"{what} {count}" for what, count in sorted(year.done.items())))
        for row in rows:
            print(f"{'ok  ' if row.good else 'MISS'} {row.what}: required {row.asked}; result {row.seen}")
    return 0 if all(row.good for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
