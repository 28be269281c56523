"""What a simulated year of a daemon and its board loses, doubles, miscounts and keeps in memory.

Run it with `make soak`, or `python benchmarks/year.py [--days 365] [--seed 1] [--json]`. The daemon restarts each day
with its spool; links, clocks, suspends and outages are drawn from the seed. Exit code 1 when a criterion failed.
"""

import argparse
import asyncio
import datetime
import gc
import logging
import random
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import psutil
from long_run_judge import FLAT, FLAT_THOUSANDS, KEPT_MB, Row, print_rows, rises, trend
from simulated_daemon import STEP_NS, S, Seen, SimulatedBoard, SimulatedDaemon, SimulatedHost, World

from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.tables import Decoding, Measurement
from resonator_daemon.board.config.values import config_of
from resonator_daemon.board.links.carriers import parse_link

_KEPT_THOUSANDS = 0.03  # a day: the samples and events of this benchmark
_SLOPES = (("rss_mb", "MB", KEPT_MB), ("blocks_thousand", "thousand blocks", FLAT_THOUSANDS), ("descriptors", "", FLAT))


HOUR_NS: Final = 3600 * S
DAY_NS: Final = 24 * HOUR_NS
START: Final = datetime.datetime(2026, 1, 1, 6, tzinfo=datetime.UTC)
SKIPS: Final = ("unplugged", "suspended", "stopped", "link_gap", "reboot")
FAULTS: Final = (None, None, "link_gap", "damaged")
STEPS_NS: Final = (-S, S, -HOUR_NS, HOUR_NS, -37 * S, 12_345_678)
TOUCH_S, SHORT_S = 2.2, 0.1
_NEAR_FRAMES: Final = 400  # from 2^32, where the last burst begins
_SKIPPED_FRAMES: Final = 20 * 86_400_000  # at most 2^31: beyond, numbers of frames are ambiguous


@dataclass
class Year:
    """Events and results of the whole time."""

    expiry: datetime.date
    seen: Seen = field(default_factory=Seen)
    samples: list[dict[str, float]] = field(default_factory=list)
    done: dict[str, int] = field(default_factory=dict)
    frames: int = 0
    frames_lost: int = 0
    touches: int = 0
    touches_wrong: list[str] = field(default_factory=list)
    is_expired: bool = False  # as the sensor's state has it
    expired_on: list[str] = field(default_factory=list)  # days
    compensation_missing: int = 0
    numbers_past_2_32: int = 0
    numbers_wrong: list[str] = field(default_factory=list)

    def did(self, what: str) -> None:
        self.done[what] = self.done.get(what, 0) + 1


async def simulate(days: int, seed: int, spool: Path, report: Callable[[str], None]) -> Year:
    """Simulate the days of a quartz16 board, which is touched each day."""
    draw = random.Random(seed)
    expiry = START.date() + datetime.timedelta(days=max(1, days * 2 // 3))
    year = Year(expiry)
    plate = load_plate("quartz16")
    calibration = plate.calibration.model_copy(update={"expiry": year.expiry})
    plate = plate.model_copy(update={"calibration": calibration})
    config = config_of(plate, _Settings(), parse_link("tcp://127.0.0.1:1"), name="left-index")  # type: ignore[arg-type]
    host = SimulatedHost(int(START.timestamp()) * S)
    board = SimulatedBoard(plate, "touches", seed)
    world = World(config, host, board, spool, year.seen)
    leap_day, expiry_day = draw.randrange(days), max(1, days * 2 // 3)
    process = psutil.Process()
    for day in range(days):
        daemon = SimulatedDaemon(world, f"{day:08x}")
        daemon.connect()
        daemon.burst(0.6)
        play = _Day(year, daemon, world, draw)
        day_end_ns = (host.elapsed_ns // DAY_NS + 1) * DAY_NS
        for _ in range(draw.randrange(4, 8)):
            play.slot(day_end_ns, leap=day == leap_day, set_clock=abs(day - expiry_day) > 1)
            await asyncio.sleep(0)
        play.skip("stopped", max(0, day_end_ns - host.elapsed_ns - HOUR_NS))
        play.touch()
        if draw.random() < 0.3:  # the next run sends what the broker has not acknowledged
            daemon.outbox.disconnected()
            year.did("events left to the next run")
            play.touch()
        else:
            await asyncio.wait_for(daemon.outbox.all_sent(), 30.0)
        host.elapsed_ns = max(host.elapsed_ns, day_end_ns)
        board.hang_up(host.elapsed_ns)
        await daemon.end()
        year.frames += board.truth.delivered
        year.frames_lost += daemon.link.machine.counters().lost.total
        _find_expiry(year)
        year.did("daemon restart")
        gc.collect()
        rss_mb, descriptors = process.memory_info().rss / 1e6, float(process.num_fds())
        held = {"rss_mb": rss_mb, "blocks_thousand": sys.getallocatedblocks() / 1e3, "descriptors": descriptors}
        year.samples.append({"day": day, **held})
        report(f"day {day}: {rss_mb:.1f} MB, {year.frames} frames, {year.touches} touches, {year.done}")
    await _deliver_the_rest(world, year, draw)
    return year


class _Day:
    """The slots of one day."""

    def __init__(self, year: Year, daemon: SimulatedDaemon, world: World, draw: random.Random) -> None:
        self._year, self._daemon, self._host, self._board = year, daemon, world.host, world.board
        self._draw = draw

    def slot(self, day_end_ns: int, *, leap: bool, set_clock: bool) -> None:
        """Skip a part of the day in one of the ways of `SKIPS`; then receive frames."""
        left_ns = day_end_ns - self._host.elapsed_ns
        self.skip(self._draw.choice(SKIPS), self._draw.randrange(S, max(left_ns // 3, 2 * S)))
        leap = leap and "leap second" not in self._year.done
        if leap or (set_clock and self._draw.random() < 0.15):
            step_ns = -S if leap else self._draw.choice(STEPS_NS)
            self._year.did("leap second" if leap else "clock set")
            self._host.step_utc(step_ns)
            self._daemon.clock_set(step_ns)
            self.touch()
        self._daemon.burst(SHORT_S, self._draw.choice(FAULTS))

    def touch(self) -> None:
        """Let one touch of the scenario pass, from 0.6 s before its start to 0.3 s after its end."""
        phase_s = self._board.scenario_s(self._host.elapsed_ns) % 2.0
        self.skip("stopped", round((0.4 - phase_s) % 2.0 * S))
        year, daemon, board = self._year, self._daemon, self._board
        onsets, releases = len(daemon.onsets), len(daemon.releases)
        board.sites_touched.clear()
        compensated = year.seen.compensated
        daemon.burst(TOUCH_S - 0.3)
        begun, ended = daemon.onsets[onsets:], daemon.releases[releases:]
        asked = sorted(board.sites_touched)
        year.touches += 1
        if sorted(site for _, site in begun) != asked or not set(begun) <= set(ended):
            year.touches_wrong.append(
                f"day {self._host.elapsed_ns // DAY_NS}: touched {asked}, onsets {begun}, releases {ended}"
            )
        year.compensation_missing += year.seen.compensated == compensated

    def pass_2_32(self) -> None:
        """Let the board's frame numbers pass 2^32 within one run, while frames come."""
        board, daemon, counters = self._board, self._daemon, self._daemon.link.machine.counters
        while (gates := (1 << 32) - board.next_sequence) > _NEAR_FRAMES:
            self.skip("link_gap", min(gates - gates // 1000 - _NEAR_FRAMES // 2, _SKIPPED_FRAMES) * board.gate_ns)
            daemon.burst(SHORT_S)
        before, first = counters(), board.next_sequence
        daemon.burst(2.0 * _NEAR_FRAMES * board.gate_ns / S)
        after, frames = counters(), board.next_sequence - first
        self._year.numbers_past_2_32 += first < 1 << 32 <= board.next_sequence
        if (after.frames - before.frames, after.lost.total - before.lost.total) != (frames, 0):
            self._year.numbers_wrong.append(f"{frames} frames sent, {before} before, {after} after")
        self.touch()

    def skip(self, how: str, duration_ns: int) -> None:
        """Let time pass in one of the ways of `SKIPS`."""
        host, board, link = self._host, self._board, self._daemon.link
        self._year.did(how)
        if how == "suspended":
            host.sleep(duration_ns)
            board.skip(host.elapsed_ns, "board_overflow")
            host.elapsed_ns += STEP_NS
        elif how in ("stopped", "link_gap"):
            host.elapsed_ns += duration_ns
            board.skip(host.elapsed_ns, "board_overflow" if how == "stopped" else "link_gap")
            host.elapsed_ns += STEP_NS  # in which the next frames come
        else:
            link.lose()
            host.elapsed_ns += duration_ns
            if how == "reboot":
                # Ticks begin near the end of a range: they pass 2^32 or 2^53 in the next minutes.
                board.reboot(host.elapsed_ns, self._draw.choice((0, (1 << 32) - 10**8, (1 << 53) - 10**8)))
            link.open()
            self._daemon.burst(0.6)  # until the board is identified and the baseline valid


def _find_expiry(year: Year) -> None:
    """Append each day on which a valid calibration has expired."""
    for _, code, since_ns in year.seen.sensor_states:
        if code == "uncalibrated" and not year.is_expired:
            year.is_expired = True
            year.expired_on.append(datetime.datetime.fromtimestamp(since_ns / S, datetime.UTC).date().isoformat())
        elif code == "measuring":
            year.is_expired = False
    year.seen.sensor_states.clear()


async def _deliver_the_rest(world: World, year: Year, draw: random.Random) -> None:
    """Start once more, so that events of the last run are delivered, and run for 50 days: 2^32 frames."""
    daemon = SimulatedDaemon(world, "ffffffff")
    daemon.connect()
    daemon.burst(0.6)
    _Day(year, daemon, world, draw).pass_2_32()
    while year.seen.events_published > len(year.seen.events):
        await asyncio.sleep(0.01)
        if daemon.outbox.events.opened and not daemon.outbox.waiting:
            break
    world.board.hang_up(world.host.elapsed_ns)
    await daemon.end()


class _Settings:
    """The tables of a configuration with their defaults."""

    def __iter__(self):  # type: ignore[no-untyped-def]
        return iter({"measurement": Measurement(), "decoding": Decoding()}.items())


def judge(year: Year) -> list[Row]:
    """Return the table."""
    seen, sums = year.seen, list(year.seen.events.values())
    expires, frames = [str(np.datetime64(year.expiry) + 1)], f"{year.frames} delivered, {year.frames_lost} lost; "
    events = f"{len(sums)} events, {sum(sums)} times"
    passed = f"{year.numbers_past_2_32} times; {_first(year.numbers_wrong)}"
    rows = (
        ("frames, bytes, messages of each run", "balance", frames + _first(seen.unbalanced), not seen.unbalanced),
        ("touches", "one onset, one release", f"{year.touches}; {_first(year.touches_wrong)}", not year.touches_wrong),
        ("events, through the spool", f"{seen.events_published} once each", events, sum(sums) == seen.events_published),
        ("events that arrived", f"{seen.events_published}", events, len(sums) == seen.events_published),
        ("t_ns", "back only by a set clock or its uncertainty", _first(seen.backwards), not seen.backwards),
        ("calibration expires", "once, after its day", ", ".join(year.expired_on), expires == year.expired_on),
        ("touches without compensation", "0", f"{year.compensation_missing}", not year.compensation_missing),
        ("frame numbers pass 2^32", "once, no frame lost", passed, passed.startswith("1 ") and not year.numbers_wrong),
    )
    slopes = (_slope(year.samples, *each) for each in _SLOPES)
    return [*(Row(*row) for row in rows), *filter(None, slopes)]


def _first(wrong: list[str]) -> str:
    return f"{len(wrong)} wrong: {wrong[0]}" if wrong else "nothing wrong"


def _slope(samples: list[dict[str, float]], name: str, unit: str, flat: float) -> Row | None:
    warm = samples[len(samples) // 4 :]
    found = trend([3600.0 * sample["day"] for sample in warm], [sample[name] for sample in warm])
    if found is None:
        return None
    if name == "blocks_thousand":
        flat += _KEPT_THOUSANDS * len(warm)
    asked = f"no slope, or below {flat:g} {unit} in all"
    seen = f"{found.per_hour:+.2g} ± {found.std_per_hour:.2g} {unit} a day, {found.rise:+.2f} in all"
    return Row(name, asked, seen, not rises(found, flat))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--days", type=int, default=365)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="the table as one object")
    options = parser.parse_args()
    logging.getLogger("resonator_daemon").propagate = False  # faults are asked for
    logging.getLogger("resonator_daemon").addHandler(logging.NullHandler())
    begun_s = time.monotonic()

    def report(text: str) -> None:
        print(f"{time.monotonic() - begun_s:7.1f} s  {text}", file=sys.stderr, flush=True)

    with tempfile.TemporaryDirectory() as folder:
        year = asyncio.run(simulate(options.days, options.seed, Path(folder) / "spool", report))
    rows = judge(year)
    print(", ".join(f"{what} {count}" for what, count in sorted(year.done.items())), file=sys.stderr)
    return print_rows(rows, as_json=options.json)


if __name__ == "__main__":
    sys.exit(main())
