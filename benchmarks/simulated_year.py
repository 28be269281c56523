"""Events of a simulated year, drawn from a seed: restarts, outages, suspends, changes of the clock."""

import asyncio
import datetime
import gc
import random
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import psutil
from simulated_daemon import EXACT, Seen, SimulatedDaemon
from simulated_disk import SimulatedDisk, until
from simulated_link import STEP_NS, S, SimulatedBoard, SimulatedHost

from resonator_daemon.config import Config, Decoding, Measurement
from resonator_daemon.config.text import config_of
from resonator_daemon.links.table import parse_link
from resonator_daemon.plate import Plate, load_plate

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
class Sample:
    """Memory and descriptors of the process at the end of a day, and the losses until then."""

    day: int
    rss_mb: float
    blocks_thousand: float
    descriptors: float
    frames_lost: float


@dataclass
class Year:
    """Events and results of the whole time."""

    expiry: datetime.date
    seen: Seen = field(default_factory=Seen)
    samples: list[Sample] = field(default_factory=list)
    done: dict[str, int] = field(default_factory=dict)
    frames: int = 0
    frames_lost: int = 0
    touches: int = 0
    touches_wrong: list[str] = field(default_factory=list)
    is_expired: bool = False  # as the sensor's state has it
    expired_on: list[str] = field(default_factory=list)  # days
    compensation_missing: int = 0
    disk_can_fill: bool = False
    disk_wrong: list[str] = field(default_factory=list)
    numbers_past_2_32: int = 0
    numbers_wrong: list[str] = field(default_factory=list)

    def did(self, what: str) -> None:
        self.done[what] = self.done.get(what, 0) + 1


async def simulate(days: int, seed: int, disk: SimulatedDisk, report: Callable[[str], None] = lambda _: None) -> Year:
    """Simulate the days of a quartz16 board, which is touched each day."""
    draw = random.Random(seed)
    expiry = START.date() + datetime.timedelta(days=max(1, days * 2 // 3))
    year = Year(expiry, disk_can_fill=disk.can_fill)
    plate = load_plate("quartz16")
    calibration = plate.calibration.model_copy(update={"expiry": year.expiry})
    plate = plate.model_copy(update={"calibration": calibration})
    config = config_of(plate, _Settings(), parse_link("tcp://127.0.0.1:1"), name="left-index")  # type: ignore[arg-type]
    host = SimulatedHost(int(START.timestamp()) * S)
    board = SimulatedBoard(plate, "touches", seed)
    leap_day, expiry_day = draw.randrange(days), max(1, days * 2 // 3)
    process = psutil.Process()
    for day in range(days):
        before = EXACT - 100_000 if day % 2 else (1 << 32) - 100_000
        full_at_start = disk.can_fill and draw.random() < 0.1
        if full_at_start:
            disk.fill()
        daemon = SimulatedDaemon(config, plate, f"{day:08x}", host, board, disk, year.seen, before)
        daemon.connect()
        daemon.burst(0.6)
        play = _Day(year, daemon, host, board, disk, draw)
        if full_at_start:
            await play.touch_on_full_disk()
        day_end_ns = (host.elapsed_ns // DAY_NS + 1) * DAY_NS
        for _ in range(draw.randrange(4, 8)):
            play.slot(day_end_ns, leap=day == leap_day, set_clock=abs(day - expiry_day) > 1)
            await asyncio.sleep(0)
        if disk.can_fill and draw.random() < 0.2:
            disk.fill()
            await play.touch_on_full_disk()
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
        blocks = sys.getallocatedblocks() / 1e3
        held = process.memory_info().rss / 1e6, blocks, float(process.num_fds())
        year.samples.append(Sample(day, *held, float(year.frames_lost)))
        report(f"day {day}: {held[0]:.1f} MB, {year.frames} frames, {year.touches} touches, {year.done}")
    await _deliver_the_rest(config, plate, host, board, disk, year, draw)
    return year


class _Day:
    """The slots of one day."""

    def __init__(
        self,
        year: Year,
        daemon: SimulatedDaemon,
        host: SimulatedHost,
        board: SimulatedBoard,
        disk: SimulatedDisk,
        draw: random.Random,
    ) -> None:
        self._year, self._daemon, self._host, self._board = year, daemon, host, board
        self._disk, self._draw = disk, draw

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
        self._daemon.burst(SHORT_S, self._draw.choice(FAULTS), replay=self._draw.random() < 0.2)

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

    async def touch_on_full_disk(self) -> None:
        """Let touches pass, half the times without a broker, until the disk has failed; then empty it."""
        year, daemon, disk = self._year, self._daemon, self._disk
        away = self._draw.random() < 0.5
        if away:
            daemon.outbox.disconnected()
        self.touch()
        await until(lambda: daemon.disk_failed and len(disk.reports) > 1)
        self.touch()
        disk.empty()
        daemon.burst(SHORT_S + 0.2)  # with a snapshot, at which a recording can begin again
        await until(lambda: daemon.disk_works)
        if away:
            daemon.connect()
        year.did("disk full")
        sources = sorted(report.partition(":")[0] for report in disk.reports)
        if sources != ["recorder", "spool"]:
            year.disk_wrong.append(f"reported {disk.reports}")
        if dropped := daemon.account().dropped.get("spool_failed"):
            year.disk_wrong.append(f"{dropped} events dropped")

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
                board.reboot(host.elapsed_ns, self._draw.choice((0, (1 << 32) - 10**8, EXACT - 10**8)))
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


async def _deliver_the_rest(
    config: Config,
    plate: Plate,
    host: SimulatedHost,
    board: SimulatedBoard,
    disk: SimulatedDisk,
    year: Year,
    draw: random.Random,
) -> None:
    """Start once more, so that events of the last run are delivered, and run for 50 days: 2^32 frames."""
    daemon = SimulatedDaemon(config, plate, "ffffffff", host, board, disk, year.seen, 0)
    daemon.connect()
    daemon.burst(0.6)
    _Day(year, daemon, host, board, disk, draw).pass_2_32()
    while year.seen.events_published > len(year.seen.events):
        await asyncio.sleep(0.01)
        if daemon.outbox.events.spool_opened and not daemon.outbox.waiting:
            break
    board.hang_up(host.elapsed_ns)
    await daemon.end()


class _Settings:
    """The tables of a configuration with their defaults."""

    def __iter__(self):  # type: ignore[no-untyped-def]
        return iter({"measurement": Measurement(), "decoding": Decoding()}.items())
