"""One run of the demo: start the parts, receive, show, stop, and report what was found."""

import asyncio
import gc
import json
import os
import sys
import tempfile
import time
import webbrowser
from collections import deque
from collections.abc import Iterator
from contextlib import AsyncExitStack, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psutil
from rich.console import Console, RenderableType
from rich.live import Live

from resonator_daemon.base.errors import ExitCode, InterruptedCommandError, UserError
from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.base.host.text import print_note
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import MQTT_3
from resonator_daemon.mqtt.subscriber import Arrival, Receiver, read_message, topic_filters
from resonator_daemon.mqtt.topics import SIGNALS, TOPICS, split_topic
from resonator_daemon.tools.demo.processes import (
    BROKER_PART,
    Child,
    Emulator,
    busy_s,
    cpu_s,
    local_broker,
    raise_if_ended,
    start_daemon,
    start_emulator,
    start_live_page,
)
from resonator_daemon.tools.demo.results import cause, delays, failures, in_words, plate_result
from resonator_daemon.tools.demo.score import SCORED_OF_FORCES, SCORED_OF_SKIN, PlateScore
from resonator_daemon.tools.demo.truth import TruthTable
from resonator_daemon.tools.view.plate_view import PlateView
from resonator_daemon.tools.view.terminal import render

_START_S: Final = 120.0  # decoders of a skin are set up first
_END_S: Final = 10.0  # for the last messages of the daemons
_STOPPED_END_S: Final = 1.0  # for them after Ctrl-C
_TURN_S: Final = 1 / 5  # period of scoring and drawing; decimated maps are published as often
_BEGIN_S: Final = 0.01  # period of looking for the messages that begin the measurement
_SWITCH_S: Final = 0.5e-3  # the longest that scoring and drawing keep the receiving thread from the interpreter
_SHOWN: Final = tuple(topic for topic in TOPICS.values() if topic != SIGNALS)
_SCORED_PATHS: Final = frozenset(topic.path for topic in (*SCORED_OF_FORCES, *SCORED_OF_SKIN))
_SHOWN_PATHS: Final = frozenset(topic.slow_path if topic.slow_hz else topic.path for topic in _SHOWN)
_OWN_PART: Final = "view and score"


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """What to show, for how long."""

    plates: tuple[str, ...]
    seconds: float
    has_page: bool  # in which the plates are pressed with the mouse
    has_view: bool  # in the terminal
    json: bool


def run_demo(options: DemoOptions) -> ExitCode:
    """Run the demo; FAILED when a touch was missed or a frame lost.

    Raises
    ------
    InterruptedCommandError
        Interrupted before the measurement began; later, an interruption ends the measurement.
    UserError
        A part does not start, or ends by itself.
    """
    plates = {name: load_plate(name) for name in dict.fromkeys(options.plates)}
    return asyncio.run(_Demo(options, plates).run())


@dataclass(slots=True)
class _Station:
    """One plate in the demo: its emulator and daemon, the view of its messages, and their score against the truth."""

    plate: Plate
    emulator: Emulator
    daemon: Child
    truth: TruthTable
    score: PlateScore
    view: PlateView


class _Demo:
    def __init__(self, options: DemoOptions, plates: dict[str, Plate]) -> None:
        self._options = options
        self._plates = plates
        self._stations: dict[str, _Station] = {}
        self._stop = asyncio.Event()
        self._setting_up: asyncio.Task[None] | None = None
        self._own_usage = psutil.Process()
        self._prefix = Mqtt().prefix
        self._arrivals: deque[Arrival] = deque()
        self._live_page: Child | None = None
        self._page_url = ""

    async def run(self) -> ExitCode:
        sys.setswitchinterval(_SWITCH_S)
        async with AsyncExitStack() as stack:
            stack.enter_context(on_signals(lambda _: self._end()))
            self._setting_up = asyncio.create_task(self._set_up(stack))
            try:
                await self._setting_up
            except asyncio.CancelledError:
                raise InterruptedCommandError("interrupted before the measurement began") from None
            self._setting_up = None
            seconds = await self._measure()
            await asyncio.gather(*(station.daemon.stop() for station in self._stations.values()))
            result = await self._evaluate(seconds)
        return self._conclude(result)

    def _end(self) -> None:
        self._stop.set()
        if self._setting_up is not None:
            self._setting_up.cancel()
            self._setting_up = None  # what ends the parts is not interrupted

    async def _set_up(self, stack: AsyncExitStack) -> None:
        """Start all parts and begin the scores; the parts end with the stack."""
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="resonatord-demo-")))
        self._broker = await stack.enter_async_context(local_broker(folder))
        url = self._broker.url
        print_note(f"broker at {url}; watch it too: resonatord watch --url {url}")
        receiver = Receiver(Mqtt(url=url), [self._filters()], self._arrivals.append, version=MQTT_3)
        receiver.start()
        stack.push_async_callback(receiver.close)
        for name, plate in self._plates.items():
            await self._start(name, plate, url, folder, stack)
        if self._options.has_page:
            await self._open_live_page(url, folder, stack)
        await self._wait_for_frames()
        gc.freeze()  # modules stay in use: collections that visit them delay messages by tens of ms
        await self._begin_scores()
        print_note(f"measuring for {self._options.seconds:g} s")

    def _filters(self) -> dict[str, int]:
        """Return the topics that are scored at their full rate, and for the page the decimated topics."""
        filters: dict[str, int] = {}
        for name, plate in self._plates.items():
            scored = SCORED_OF_SKIN if plate.decodable else SCORED_OF_FORCES
            filters |= topic_filters(self._prefix, scored, plate=name, full_rate=True)
        if self._options.has_view:
            filters |= topic_filters(self._prefix, _SHOWN, full_rate=False)
        return filters

    async def _start(self, name: str, plate: Plate, broker_url: str, folder: Path, stack: AsyncExitStack) -> None:
        """Start the processes of one plate; they end with the stack."""
        print_note(f"starting emulated board and daemon: {name}")
        emulator = await start_emulator(name, plate, folder, by_hand=self._options.has_page)
        stack.push_async_callback(emulator.child.stop)
        daemon = await start_daemon(name, emulator.link, broker_url, folder)
        stack.push_async_callback(daemon.stop)
        truth = TruthTable(emulator.truth)
        score = PlateScore(truth, plate.counter.frame_rate_hz, plate.site_positions_m, touched_anywhere=plate.decodable)
        self._stations[name] = _Station(plate, emulator, daemon, truth, score, PlateView(name))

    async def _open_live_page(self, broker_url: str, folder: Path, stack: AsyncExitStack) -> None:
        """Start the page in which the plates are pressed with the mouse, and open it where there is a desktop."""
        controls = [station.emulator.control for station in self._stations.values()]
        try:
            self._live_page, self._page_url = await start_live_page(broker_url, controls, folder)
        except UserError as error:  # an optional extension
            print_note(f"no page to press the plates in: {error}")
            return
        stack.push_async_callback(self._live_page.stop)
        print_note(f"press the plates with the mouse, until the end of the demo: {self._page_url}")
        if any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")):
            await asyncio.to_thread(webbrowser.open, self._page_url)

    def _take_arrivals(self) -> None:
        """Add the messages that have arrived to the scores and the views."""
        while self._arrivals:
            arrival = self._arrivals.popleft()
            name, path = split_topic(self._prefix, arrival.topic)
            if (station := self._stations.get(name)) is None:
                continue
            if path in _SCORED_PATHS:
                station.score.add(path, arrival.payload, arrival.arrived_ns)
            if self._options.has_view and path in _SHOWN_PATHS:
                shown = read_message(self._prefix, arrival)
                if shown is not None:
                    station.view.add(shown.path, shown.message, arrival.arrived_ns)
        for station in self._stations.values():
            station.score.join()

    async def _measure(self) -> float:
        """Measure for the time asked for; return how long it was."""
        used_before, busy_before_s = self._processor_times(), busy_s()
        started = time.monotonic()
        console = Console()
        live = Live(console=console, screen=True, auto_refresh=False) if self._options.has_view else nullcontext()
        with live as screen:
            while (left_s := started + self._options.seconds - time.monotonic()) > 0 and not self._stop.is_set():
                raise_if_ended(self._children())
                self._take_arrivals()
                if screen is not None:
                    screen.update(self._page(left_s), refresh=True)
                await self._pause(min(left_s, _TURN_S))
        self._take_arrivals()
        self._used_s = {part: used_s - used_before[part] for part, used_s in self._processor_times().items()}
        self._busy_s = busy_s() - busy_before_s
        self._memory_mb = {child.part: child.rss_mb() for child in self._children()}
        self._ended_ns = time.time_ns()
        return time.monotonic() - started

    def _processor_times(self) -> dict[str, float]:
        """Return the processor time of each part since its start, in seconds."""
        broker, *others = self._children()
        parts = {child.part: child.cpu_s() for child in others}
        return {BROKER_PART: broker.cpu_s(), _OWN_PART: cpu_s(self._own_usage)} | parts

    async def _pause(self, seconds: float) -> None:
        with suppress(TimeoutError):
            await asyncio.wait_for(self._stop.wait(), seconds)

    async def _wait_for_frames(self) -> None:
        deadline = time.monotonic() + _START_S
        while True:
            raise_if_ended(self._children())
            self._take_arrivals()
            silent = [name for name, station in self._stations.items() if not station.score.started]
            if not silent:
                return
            if time.monotonic() > deadline:
                raise UserError(f"no frame of {' and '.join(silent)} within {_START_S:g} s")
            await asyncio.sleep(_TURN_S)

    async def _begin_scores(self) -> None:
        """Begin the score of each daemon at its next `health`."""
        for station in self._stations.values():
            station.score.begin()
        while not all(station.score.begun for station in self._stations.values()):
            raise_if_ended(self._children())
            await asyncio.sleep(_BEGIN_S)
            self._take_arrivals()

    async def _wait_for_last_messages(self) -> None:
        """Wait for each daemon's last message, the state offline: up to 10 s, after Ctrl-C up to 1 s."""
        deadline = time.monotonic() + (_STOPPED_END_S if self._stop.is_set() else _END_S)
        while time.monotonic() < deadline and not all(each.score.ended for each in self._stations.values()):
            await asyncio.sleep(_TURN_S)
            self._take_arrivals()

    def _children(self) -> Iterator[Child]:
        yield self._broker.child
        for station in self._stations.values():
            yield station.daemon
            yield station.emulator.child
        if self._live_page is not None:
            yield self._live_page

    def _page(self, left_s: float) -> RenderableType:
        lines = {name: station.truth.lines[-1:] for name, station in self._stations.items()}
        truths = {name: last[0].contacts for name, last in lines.items() if last}
        views = [station.view for station in self._stations.values()]
        page = f"; press the plates: {self._page_url}" if self._page_url else ""
        title = f"resonatord demo, {left_s:.0f} s left, Ctrl-C ends it{page}"
        return render(views, truths, time.time_ns(), title=title)

    async def _evaluate(self, seconds: float) -> dict[str, Any]:
        await self._wait_for_last_messages()
        plates = {}
        for name, station in self._stations.items():
            station.truth.close()
            part = station.daemon.part
            plates[name] = plate_result(station.score, self._ended_ns, has_skin=station.plate.decodable) | {
                "cpu_percent": round(100 * self._used_s[part] / seconds, 1),
                "rss_mb": round(self._memory_mb[part], 1),
            }
        return {
            "seconds": round(seconds, 3),
            "broker": self._broker.name,
            "plates": plates,
            "cores": round(sum(self._used_s.values()) / seconds, 3),
            "cpu_percent_by_part": {part: round(100 * used_s / seconds, 1) for part, used_s in self._used_s.items()},
        }

    def _conclude(self, result: dict[str, Any]) -> ExitCode:
        plates = result["plates"].items()
        failed = [f"{name}: {clause}" for name, plate in plates for clause in failures(plate)]
        late = [f"{name}: {', '.join(clauses)}" for name, plate in plates if (clauses := delays(plate))]
        health = [message for station in self._stations.values() for message in station.score.health]
        wait_percent = max((message["processor_wait_percent"] for message in health), default=0.0)
        others = max(self._busy_s / result["seconds"] - result["cores"], 0.0)
        why = cause(
            f"these processes used {result['cores']:.2f} of {psutil.cpu_count() or 1} cores, others {others:.2f}; "
            f"a daemon waited for a core up to {wait_percent:.0f} % of the time",
            overloaded=any(message["reason_code"] for message in health),
        )
        remarks = [*late, *why] if late or failed else []
        if not self._options.json:
            sys.stdout.write(in_words(result) + "".join(f"{line}\n" for line in remarks))
            sys.stdout.flush()  # before an error
        if failed:
            lines = [*failed, *(remarks if self._options.json else ())]
            raise UserError(*lines, partial_result=result, code="lost", exit_code=ExitCode.FAILED)
        if self._options.json:
            for line in remarks:
                print_note(line)
            sys.stdout.write(json.dumps(result) + "\n")
        return ExitCode.DONE
