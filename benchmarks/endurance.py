"""Outages and kills at full length, in one table: broker frozen, dead or slow, kill orders, killed recorders, hang-ups.

Run it with `make soak`, or `python benchmarks/endurance.py [--share X] [--seed N]`; it takes about an hour, a share of
it less. Each run has a benchmark of its own, which prints more. Exit code 1 when a criterion failed.
"""

import argparse
import asyncio
import logging
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import broker_outage
from hang_ups import RECOVERY_LIMIT_S, hang_up
from kill_recording import LOSS_AT_MOST_S, kill_and_read
from kill_restore import CONVERGED_S, kill_and_restore

_OUTAGE_S: Final = 60.0
_DEAD: Final = 10  # times as long
_KILLS, _HANG_UPS = 200, 1000


class Row(NamedTuple):
    """One run: its requirement, its result, the balance of its counters, and its failures."""

    run: str
    requirement: str
    result: str
    balance: str
    wrong: list[str]


def outage(case: str, seconds: float, folder: Path) -> Row:
    found = asyncio.run(broker_outage.measure(case, seconds, folder))
    lasted_s = seconds * (_DEAD if case == "dead" else 1)
    return Row(
        f"broker {case}, {lasted_s:g} s", "no frame lost, no event missing", found.seen, found.balance, found.wrong
    )


def orders(runs: int, seed: int, folder: Path) -> Row:
    found = asyncio.run(kill_and_restore(runs, folder, seed=seed))
    longest_s = max(found.converged_s, default=float("nan"))
    kills = ", ".join(f"{part} {count}" for part, count in sorted(found.kills.items()))
    return Row(
        f"{runs} kill orders",
        f"states right within {CONVERGED_S:g} s",
        f"{len(found.converged_s)} converged, longest {longest_s:.2f} s",
        f"kills: {kills}",
        found.wrong,
    )


def recorders(runs: int, seed: int, folder: Path) -> Row:
    found = kill_and_read(runs, seed, folder)
    longest_s = max(found.lost_s, default=float("nan"))
    return Row(
        f"{runs} kill -9 while recording",
        f"at most {LOSS_AT_MOST_S:g} s missing",
        f"{len(found.lost_s)} files readable and repaired, longest loss {longest_s:.2f} s",
        f"{len(found.lost_s)} files with events, {found.empty} without, of {runs}",
        found.wrong,
    )


def hang_ups(times: int, seed: int, folder: Path) -> Row:
    found = hang_up(times, folder, seed)
    return Row(
        f"{times} hang-ups",
        f"frames within {RECOVERY_LIMIT_S:g} s (p99), no leak",
        f"{len(found.recoveries_s)} of {found.lasting} returned, p99 {found.p99_s:.2f} s",
        ", ".join(f"{count:+d} {what}" for what, count in found.more.items()),
        found.wrong,
    )


def runs(share: float, seed: int) -> Iterator[Callable[[Path], Row]]:
    """Yield all runs, at this share of their full length."""
    for case in broker_outage.CASES:
        if case != "full-disk" or not os.geteuid():  # it mounts a small file system
            yield partial(outage, case, _OUTAGE_S * share)
    yield partial(orders, max(2, round(_KILLS * share)), seed)
    yield partial(recorders, max(1, round(_KILLS * share)), seed)
    yield partial(hang_ups, max(1, round(_HANG_UPS * share)), seed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="of the full length, as 0.02")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    rows = []
    for run in runs(options.share, options.seed):
        with tempfile.TemporaryDirectory() as folder:
            began_s = time.monotonic()
            rows.append(run(Path(folder)))
            print(f"{rows[-1].run}: {time.monotonic() - began_s:.0f} s", file=sys.stderr, flush=True)
    print("\n| run | requirement | result | balance | failures |\n| --- | --- | --- | --- | --- |")
    for row in rows:
        print(f"| {row.run} | {row.requirement} | {row.result} | {row.balance} | {'; '.join(row.wrong) or 'none'} |")
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
