"""Latency from the board's edge to a subscriber's callback, with every part as a process of its own."""

import asyncio
import contextlib
import gc
import json
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil
from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.config import Measurement, Mqtt
from resonator_daemon.demo.latency_report import Arrival, LatencyReport, measure, read_gates
from resonator_daemon.demo.local_broker import local_broker
from resonator_daemon.demo.processes import Child, cpu_s, raise_if_ended, start_daemons, start_emulator
from resonator_daemon.errors import ExitCode, InterruptedCommandError, LossError, UserError
from resonator_daemon.host.printable import print_note
from resonator_daemon.host.signals import on_signals
from resonator_daemon.plate import load_plate
from resonator_daemon.publishing.broker_connection import BrokerConnection
from resonator_daemon.publishing.mqtt_messages import Incoming
from resonator_daemon.publishing.reconnection import connection_session, keep_connected
from resonator_daemon.publishing.requests import reach
from resonator_daemon.publishing.topics import DECODED, FORCES, HEALTH, full_topic

_HEAD_BYTES: Final = 512  # of arrays; the keys that are read are within
_START_S: Final = 120.0  # the first time, a decoder is set up for more than ten seconds
_SETTLE_S: Final = 3.0  # caches are warm and the board's clock is known
_LOOK_S: Final = 0.5
_SUBSCRIBER: Final = "subscriber"
_NAME: Final = "bench"


@dataclass(frozen=True, slots=True)
class LatencyOptions:
    """What to measure, for how long."""

    plate: str
    seconds: float
    external: bool = False  # decode in a process of its own
    broker: str | None = None  # None: one is started
    json: bool = False
    picture: Path | None = None


def bench_latency(options: LatencyOptions) -> ExitCode:
    """Measure and print a report.

    Raises
    ------
    UserError
        A part does not start, or ends by itself.
    InterruptedCommandError
        Interrupted before the time was over; what was measured by then is reported.
    LossError
        A message is missing.
    """
    bench = _Bench(options)
    report = asyncio.run(bench.run())
    if options.picture is not None:
        report.write_picture(options.picture)
    if not options.json:
        sys.stdout.write(report.in_words())
    if bench.cut_short:
        words = f"interrupted: measured for {report.seconds:.1f} of {options.seconds:g} s"
        raise InterruptedCommandError(words, so_far=report.as_json())
    if report.latency.missing:
        raise LossError(f"{report.latency.missing} messages are missing", so_far=report.as_json())
    if options.json:
        sys.stdout.write(json.dumps(report.as_json()) + "\n")
    return ExitCode.DONE


class _Subscriber:
    """Notes when messages came, and reads nothing: that would delay those behind them."""

    def __init__(self, prefix: str, path: str) -> None:
        self._topic = full_topic(prefix, _NAME, path)
        self.topics = (self._topic, full_topic(prefix, _NAME, HEALTH.path))
        self._path = path
        self._health: list[bytes] = []
        self.arrivals: list[Arrival] = []
        self.first_came = asyncio.Event()
        self.counting = False

    def receive(self, message: Incoming) -> None:
        now_ns = time.time_ns()
        if message.topic != self._topic:
            if self.counting:
                self._health.append(message.payload)
            return
        if self.counting:
            arrays = not message.payload.startswith(b"{")
            self.arrivals.append(Arrival(now_ns, message.payload[:_HEAD_BYTES] if arrays else message.payload))
        elif not self.first_came.is_set():
            self.first_came.set()

    def daemon_counts(self) -> tuple[int, ...] | None:
        """Return the daemon's own histogram from the first `health` to the last; None where it keeps none."""
        if not self._health:
            return None
        first, last = (json.loads(self._health[at])["latency"].get(self._path) for at in (0, -1))
        if first is None or last is None:
            return None
        return tuple(after - before for before, after in zip(first["counts"], last["counts"], strict=True))


class _Bench:
    def __init__(self, options: LatencyOptions) -> None:
        self._options = options
        self._plate = load_plate(options.plate)
        self._topic = DECODED if self._plate.decodable else FORCES
        if options.external and not self._plate.decodable:
            raise UserError(f"--external: nothing is decoded on plate {options.plate}; leave it out")
        self._ended = asyncio.Event()
        self.cut_short = False

    async def run(self) -> LatencyReport:
        async with AsyncExitStack() as stack:
            stack.enter_context(on_signals(lambda _: self._ended.set()))
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="resonatord-bench-")))
            if self._options.broker is None:
                local = await stack.enter_async_context(local_broker(folder))
                broker, url, brokers = local.name, local.url, [local.child]
            else:
                broker, url, brokers = self._options.broker, self._options.broker, []
            settings = Mqtt(url=url).with_name("--broker")
            await reach(settings)
            subscriber = _Subscriber(settings.prefix, self._topic.path)
            await stack.enter_async_context(_listening(settings, subscriber))
            print_note(f"broker: {broker}")
            children: list[Child] = []
            stack.push_async_callback(_stop, children)
            truth = await self._start(children, folder, url)
            await self._wait_for_messages(subscriber, children)
            seconds, usage = await self._measure(subscriber, [*brokers, *children])
            await _stop(children)  # upon which the truth is written in full
            print_note("reading the truth")
            with truth.open() as lines:
                gates = read_gates(lines)
        if not subscriber.arrivals:
            self._refuse_to_go_on()
            raise UserError(f"no message on {self._topic.path} within {seconds:.1f} s")
        rate_hz = self._plate.counter.frame_rate_hz
        gates_apart = round(Measurement().step_s * rate_hz) if self._topic is FORCES else 1
        return LatencyReport(
            plate=self._options.plate,
            topic=self._topic.path,
            external=self._options.external,
            broker=broker,
            seconds=seconds,
            latency=measure(subscriber.arrivals, gates, gates_apart),
            daemon_counts=subscriber.daemon_counts(),
            cpu_percent_by_part=usage,
            load_average=psutil.getloadavg()[0],
        )

    async def _start(self, children: list[Child], folder: Path, url: str) -> Path:
        """Start the parts as a user would; return the truth file."""
        plate = self._options.plate
        print_note(f"starting an emulated board and its daemon: {plate}")
        emulator = await start_emulator(plate, self._plate, folder)
        children.append(emulator.child)
        verbs = {f"resonatord {verb}": verb for verb in (("run", "decode") if self._options.external else ("run",))}
        children += await start_daemons(verbs, _NAME, plate, emulator.link, url, folder)
        return emulator.truth

    async def _wait_for_messages(self, subscriber: _Subscriber, children: list[Child]) -> None:
        print_note(f"waiting for {self._topic.path}")
        for event, seconds in ((subscriber.first_came, _START_S), (self._ended, _SETTLE_S)):
            deadline = time.monotonic() + seconds
            while not event.is_set() and not self._ended.is_set() and time.monotonic() < deadline:
                raise_if_ended(children)
                await asyncio.sleep(_LOOK_S)
        self._refuse_to_go_on()
        if not subscriber.first_came.is_set():
            raise UserError(f"no message on {self._topic.path} within {_START_S:g} s")

    def _refuse_to_go_on(self) -> None:
        if self._ended.is_set():
            raise InterruptedCommandError("interrupted before a message was measured")

    async def _measure(self, subscriber: _Subscriber, children: list[Child]) -> tuple[float, dict[str, float]]:
        """Count messages for the time asked for; return how long that was, and processor time by part."""
        print_note(f"measuring for {self._options.seconds:g} s")
        gc.collect()
        gc.freeze()
        gc.disable()  # a look through all that has arrived would delay what comes meanwhile
        await asyncio.sleep(_LOOK_S)  # what came during that look is over
        own = psutil.Process()
        own_mark_s = cpu_s(own)
        for child in children:
            child.mark()
        started = time.monotonic()
        subscriber.counting = True
        while (left_s := started + self._options.seconds - time.monotonic()) > 0 and not self._ended.is_set():
            raise_if_ended(children)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._ended.wait(), min(left_s, 10.0))
        self.cut_short = left_s > 0
        subscriber.counting = False
        seconds = time.monotonic() - started
        gc.enable()
        used_s = {child.part: child.cpu_s() for child in children} | {_SUBSCRIBER: cpu_s(own) - own_mark_s}
        return seconds, {part: round(100 * part_s / seconds, 1) for part, part_s in used_s.items()}


@asynccontextmanager
async def _listening(broker: Mqtt, subscriber: _Subscriber) -> AsyncIterator[None]:
    """Listen as long as the context lasts; what comes goes to the subscriber in the callback that read it."""
    closing: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def make_connection(version: MQTTProtocolVersion) -> BrokerConnection:
        return BrokerConnection(broker, version, on_message=subscriber.receive)

    async def serve(client: BrokerConnection, _at_once: bool) -> None:
        for topic in subscriber.topics:
            client.subscribe(topic, qos=0)
        await asyncio.wait([client.lost, closing], return_when=asyncio.FIRST_COMPLETED)

    session = connection_session(make_connection, serve, closing)
    connection = asyncio.create_task(keep_connected(broker, session, closing))
    try:
        yield
    finally:
        closing.set_result(None)
        await connection


async def _stop(children: list[Child]) -> None:
    for child in reversed(children):  # the board last: its daemon must not report that it went away
        await child.stop()
    children.clear()
