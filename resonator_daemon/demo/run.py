"""One run of the demo: start the parts, listen, show, stop, and say what was found."""

import asyncio
import gc
import json
import signal
import sys
import tempfile
import time
from contextlib import AsyncExitStack, aclosing, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.console import Console
from rich.live import Live

from resonator_daemon.config import Mqtt
from resonator_daemon.demo.processes import Child, start_daemon, start_emulator
from resonator_daemon.demo.score import PlateScore
from resonator_daemon.demo.truth import TruthTable, site_traction, surface_traction
from resonator_daemon.errors import ExitCode, OperatorError
from resonator_daemon.plate import Plate, load_plate
from resonator_daemon.publishing.embedded_broker import embedded_broker
from resonator_daemon.publishing.payloads import DecodedSummary, Forces, Health
from resonator_daemon.publishing.subscriber import subscribe
from resonator_daemon.publishing.topics import CONTACTS, SIGNALS, TOPICS
from resonator_daemon.view.plate_view import PlateView, TrueContact, Truth
from resonator_daemon.view.terminal import render

_HEARD = tuple(topic for topic in TOPICS.values() if topic not in (SIGNALS, CONTACTS))  # shown and scored
_START_S = 60.0  # decoders of a skin are set up first
_JOIN_S = 0.05
_QUIET_S = 0.3
_LATE_MS = 50.0
_DRAW_HZ = 8.0
_BROKER_PART = "broker, view and score"


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """What to show, for how long."""

    plates: tuple[str, ...]
    seconds: float
    headless: bool
    json: bool


def run_demo(options: DemoOptions) -> ExitCode:
    """Run the demo; FAILED when a touch was missed or a frame lost."""
    plates = {name: load_plate(name) for name in dict.fromkeys(options.plates)}
    return asyncio.run(_Demo(options, plates).run())


@dataclass(slots=True)
class _Station:
    """One plate in the demo: its emulator and daemon, what was heard, and how well it fits the truth."""

    plate: Plate
    emulator: Child
    daemon: Child
    truth: TruthTable
    score: PlateScore
    view: PlateView
    first_frame_seen: bool = False


class _Demo:
    def __init__(self, options: DemoOptions, plates: dict[str, Plate]) -> None:
        self._options = options
        self._plates = plates
        self._stations: dict[str, _Station] = {}
        self._stop = asyncio.Event()
        self._all_started = asyncio.Event()
        self._own_usage = psutil.Process()
        self._heard = asyncio.Event()

    async def run(self) -> ExitCode:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, self._stop.set)
        async with AsyncExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="resonatord-demo-")))
            broker_url = await stack.enter_async_context(embedded_broker())
            self._tell(f"broker at {broker_url}; watch it too: resonatord watch --url {broker_url}")
            listening = asyncio.create_task(self._listen(Mqtt(url=broker_url)))
            stack.push_async_callback(_cancel, listening)
            for name, plate in self._plates.items():
                stack.push_async_callback((await self._start(name, plate, broker_url, folder)).emulator.stop)
            try:
                seconds = await self._measure()
            finally:
                for station in self._stations.values():
                    await station.daemon.stop()
            result = await self._evaluate(seconds)
        return self._conclude(result)

    async def _start(self, name: str, plate: Plate, broker_url: str, folder: Path) -> _Station:
        self._tell(f"starting emulated board and daemon: {name}")
        emulator, link, truth_path = await start_emulator(name, folder, plate.counter.kind)
        daemon = await start_daemon(name, link, broker_url, folder)
        truth = TruthTable(truth_path)
        score = PlateScore(truth, plate.counter.frame_rate_hz, plate.site_positions_m)
        station = _Station(plate, emulator, daemon, truth, score, PlateView(name))
        self._stations[name] = station
        return station

    async def _listen(self, broker: Mqtt) -> None:
        async with aclosing(subscribe(broker, _HEARD)) as messages:
            async for name, path, message in messages:
                arrived_ns = time.time_ns()
                self._heard.set()
                if (station := self._stations.get(name)) is None:
                    continue
                station.score.take(message, arrived_ns)
                station.view.take(path, message, arrived_ns)
                if not station.first_frame_seen and isinstance(message, Forces | DecodedSummary):
                    station.first_frame_seen = True
                    if sum(each.first_frame_seen for each in self._stations.values()) == len(self._plates):
                        self._all_started.set()

    async def _measure(self) -> float:
        """Wait for the first frame of every plate, then measure for the time asked for; return how long it was."""
        await self._wait_for_frames()
        self._tell(f"measuring for {self._options.seconds:g} s")
        gc.freeze()  # what was imported stays: a look through all of it would delay every message by tens of ms
        for station in self._stations.values():
            station.score.begin(time.time_ns())
            station.emulator.mark()
            station.daemon.mark()
        self._own_mark_s = _cpu_s(self._own_usage)
        started = time.monotonic()
        console = Console()
        live = nullcontext() if self._options.headless else Live(console=console, screen=True, auto_refresh=False)
        with live as screen:
            next_drawn = started
            while (elapsed_s := time.monotonic() - started) < self._options.seconds and not self._stop.is_set():
                self._complain_of_dead_children()
                for station in self._stations.values():
                    station.score.join()
                if screen is not None and time.monotonic() >= next_drawn:
                    screen.update(self._picture(self._options.seconds - elapsed_s), refresh=True)
                    next_drawn = time.monotonic() + 1 / _DRAW_HZ
                await asyncio.sleep(_JOIN_S)
        self._usage = {_BROKER_PART: _cpu_s(self._own_usage) - self._own_mark_s}
        self._memory_mb = {}
        for station in self._stations.values():
            for child in (station.daemon, station.emulator):
                self._usage[child.part] = child.cpu_s()
                self._memory_mb[child.part] = child.rss_mb()
        self._ended_ns = time.time_ns()
        return time.monotonic() - started

    async def _wait_for_frames(self) -> None:
        waiting = [asyncio.create_task(event.wait()) for event in (self._all_started, self._stop)]
        deadline = time.monotonic() + _START_S
        try:
            while not self._all_started.is_set() and not self._stop.is_set():
                self._complain_of_dead_children()
                if time.monotonic() > deadline:
                    silent = [name for name, station in self._stations.items() if not station.first_frame_seen]
                    raise OperatorError(f"no frame of {' and '.join(silent)} within {_START_S:g} s")
                await asyncio.wait(waiting, timeout=0.2, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in waiting:
                task.cancel()

    def _complain_of_dead_children(self) -> None:
        for station in self._stations.values():
            for child in (station.emulator, station.daemon):
                if complaint := child.complaint():
                    raise OperatorError(complaint)

    def _picture(self, left_s: float) -> Any:
        truths = {name: _truth_to_show(station) for name, station in self._stations.items()}
        views = [station.view for station in self._stations.values()]
        title = f"resonatord demo, {left_s:.0f} s left, Ctrl-C ends it"
        return render(views, truths, time.time_ns(), title=title)

    async def _wait_for_quiet(self) -> None:
        """Return when no message came for a while; the daemons are gone, so that this ends."""
        with suppress(TimeoutError):
            while True:
                self._heard.clear()
                await asyncio.wait_for(self._heard.wait(), _QUIET_S)

    async def _evaluate(self, seconds: float) -> dict[str, Any]:
        await self._wait_for_quiet()  # the last messages of the daemons are on their way
        plates = {}
        for name, station in self._stations.items():
            station.score.join()
            station.truth.close()
            plates[name] = self._plate_result(station, seconds)
        cores = sum(self._usage.values()) / seconds
        return {
            "seconds": round(seconds, 3),
            "broker": "amqtt",
            "plates": plates,
            "cores": round(cores, 3),
            "cpu_percent_by_part": {part: round(100 * cpu_s / seconds, 1) for part, cpu_s in self._usage.items()},
        }

    def _plate_result(self, station: _Station, seconds: float) -> dict[str, Any]:
        accuracy = station.score.accuracy(self._ended_ns)
        health = station.score.health[-1] if station.score.health else None
        skin = station.plate.skin is not None
        part = station.daemon.part
        return {
            "frames": station.score.frames,
            "lost": station.score.lost,
            "frame_rate_hz": _frame_rate_hz(station.score.health),
            "latency_ms": _percentiles(accuracy.latency_ms),
            "contacts_true": accuracy.touches,
            "contacts_found": accuracy.found,
            "sites_right": None if skin else accuracy.sites_right,  # a skin is touched anywhere
            "force_error_newton_rms": _rounded(accuracy.force_error_newton_rms),
            "position_error_mm_rms": _rounded(accuracy.position_error_m_rms, 1e3),  # None: the position is the site's
            "decoded_frames": station.score.decoded_frames if skin else None,
            "traction_error": _rounded(accuracy.traction_error),
            "parts_lost": health.parts_lost if health else None,
            "cpu_percent": round(100 * self._usage[part] / seconds, 1),
            "rss_mb": round(self._memory_mb[part], 1),
        }

    def _conclude(self, result: dict[str, Any]) -> ExitCode:
        failures = [f"{name}: {failure}" for name, plate in result["plates"].items() for failure in _failures(plate)]
        if self._options.json:
            sys.stdout.write(json.dumps(result) + "\n")
        else:
            sys.stdout.write(_in_words(result))
        for failure in failures:
            self._tell(failure)
        return ExitCode.FAILED if failures else ExitCode.DONE

    def _tell(self, text: str) -> None:
        sys.stderr.write(text + "\n")
        sys.stderr.flush()


async def _cancel(task: "asyncio.Task[None]") -> None:
    task.cancel()
    await asyncio.wait([task])


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _truth_to_show(station: _Station) -> Truth:
    lines = station.truth.lines
    percentiles = _percentiles(station.score.latency_ms[-500:])
    plate, traction = station.plate, None
    if lines and plate.grid:
        traction = surface_traction(lines[-1], (plate.grid.shape[0], plate.grid.shape[1]), plate.grid.pitch_m)[2]
    elif lines and plate.skin:
        traction = site_traction(lines[-1], plate.site_positions_m)[2]
    contacts = lines[-1].contacts if lines else ()
    return Truth(
        contacts=tuple(
            TrueContact(contact["site"], tuple(contact["position_m"]), tuple(contact["force_newton"]))
            for contact in contacts
        ),
        traction_z_pascal=traction,
        latency_ms=(percentiles["p50"], percentiles["p99"]) if percentiles else None,
    )


def _percentiles(latency_ms: list[float]) -> dict[str, float] | None:
    if not latency_ms:
        return None
    p50, p99 = np.percentile(latency_ms, [50, 99])
    return {"p50": round(float(p50), 2), "p99": round(float(p99), 2)}


def _frame_rate_hz(health: list[Health]) -> float | None:
    if len(health) < 2:
        return None
    first, last = health[0], health[-1]
    return round((last.frames - first.frames) / (last.uptime_s - first.uptime_s), 1)


def _rounded(value: float | None, scale: float = 1.0) -> float | None:
    return None if value is None else round(scale * value, 5)


def _failures(plate: dict[str, Any]) -> list[str]:
    failures = [f"{count} lost: {cause}" for cause, count in plate["lost"].items() if count]
    if not plate["frames"]:
        failures.append("no frame arrived")
    if plate["decoded_frames"] == 0:
        failures.append("no frame was decoded")
    for what, key in (("found", "contacts_found"), ("given the right site", "sites_right")):
        if plate[key] is not None and (missed := plate["contacts_true"] - plate[key]):
            failures.append(f"{missed} of {plate['contacts_true']} touches not {what} within 50 ms")
    if plate["latency_ms"] and plate["latency_ms"]["p99"] > _LATE_MS and failures:
        failures.append(f"messages came {plate['latency_ms']['p99']:.0f} ms late (99 %): this machine is too busy")
    return failures


def _in_words(result: dict[str, Any]) -> str:
    lines = [f"{result['seconds']:.0f} s, broker {result['broker']}, {result['cores']:.2f} processor cores in all"]
    lines += [f"  {percent:5.1f} %  {part}" for part, percent in result["cpu_percent_by_part"].items()]
    for name, plate in result["plates"].items():
        lost = sum(plate["lost"].values())
        lines.append(f"{name}: {plate['frames']} frames, {lost} lost, {plate['frame_rate_hz']} frames/s")
        if latency := plate["latency_ms"]:
            lines.append(f"  touch to subscriber: {latency['p50']} ms (median), {latency['p99']} ms (99 %)")
        at_site = "" if plate["sites_right"] is None else f", {plate['sites_right']} at the right site"
        lines.append(f"  touches: {plate['contacts_found']} of {plate['contacts_true']} found{at_site}")
        if (error := plate["force_error_newton_rms"]) is not None:
            lines.append(f"  force error: {1e3 * error:.2f} mN rms")
        if (error := plate["position_error_mm_rms"]) is not None:
            lines.append(f"  position error: {error:.3f} mm rms")
        if plate["decoded_frames"] is not None:
            lines.append(f"  decoded: {plate['decoded_frames']} frames, traction error {plate['traction_error']}")
    return "\n".join(lines) + "\n"
