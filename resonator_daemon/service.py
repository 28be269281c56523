"""The daemon for one board: the only place where acquisition, measurement, decoding and publishing are joined."""

import asyncio
import contextlib
import gc
import logging
import secrets
import signal
import sys
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

from resonator_daemon.acquisition.account import LinkAccount
from resonator_daemon.acquisition.board import BoardReader
from resonator_daemon.acquisition.frames import (
    Arrival,
    BoardOnline,
    BoardRefused,
    BoardSays,
    ChannelisedFrame,
    Gap,
    LinkChange,
    Outage,
    ReaderFailed,
    SingleToneFrame,
)
from resonator_daemon.acquisition.recording_switch import RecordingSwitch
from resonator_daemon.command_handlers import CommandHandlers, DaemonParts, ForceChain
from resonator_daemon.config import Config, Measurement, plate_name
from resonator_daemon.daemon_state import DaemonStanding, DaemonState
from resonator_daemon.decoding.stage import SWITCH_S
from resonator_daemon.errors import ConfigError, IncompatibleBoardError, OperatorError
from resonator_daemon.health import HealthMonitor
from resonator_daemon.measuring import Measuring, useful_together
from resonator_daemon.outlet import Outlet
from resonator_daemon.plate import Plate
from resonator_daemon.publishing.payloads import Condition, Health, Lost, MessageAccount, State
from resonator_daemon.publishing.topics import HEALTH, INFO, STATE_DAEMON, STATE_LINK, STATE_SENSOR, Topic
from resonator_daemon.recording_commands import RecordingCommands, recording_info
from resonator_daemon.reports import Reporter
from resonator_daemon.sensor_state import SensorState
from resonator_daemon.silence import Silence

log = logging.getLogger(__name__)

_HEALTH_S = 1.0
_TOGETHER = 50  # arrivals


async def serve(config: Config) -> None:
    """Measure and publish until SIGINT, SIGTERM or SIGHUP.

    Raises
    ------
    OperatorError
        The first board on the link can never serve this configuration.
    """
    service = Service(config)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, service.stop)
    sys.setswitchinterval(SWITCH_S)
    await service.run()


class Service:
    """One board from its bytes to its messages."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._arrived = asyncio.Event()
        wake = self._wake_from(asyncio.get_running_loop())
        self._recording = RecordingSwitch()
        steps = useful_together(config.plate, config.measurement)
        self._reader = BoardReader(config.link, config.plate, wake, step_frames=steps, tap=self._recording.tap)
        self._daemon_boot_id = secrets.token_hex(8)
        self._reporter = Reporter(config, self._daemon_boot_id, self._lost)
        self._outlet = Outlet(config, self._daemon_boot_id, self._make_offline)
        self._tasks = asyncio.TaskGroup()
        self._monitor = HealthMonitor()
        self._daemon = DaemonState(self._daemon_boot_id, self._say_daemon, self._outlet.restore)
        self._sensor = SensorState(self._say_sensor, _what_is_read(config.plate))
        self._measuring = Measuring(config, self._reporter, self._sensor, self._publish)
        self._silence = Silence(asyncio.get_running_loop(), self._measuring.end_contacts)
        self._board: BoardOnline | None = None
        self._boots = 0
        self._limits_hz: Mapping[str, float] = {}  # of topics whose rate a command has lowered
        self._link: LinkChange | None = None
        self._outage: Outage | None = None
        self._board_boot_id: int | None = None
        self._fatal: OperatorError | None = None
        self._stopping = False
        self._started_utc_ns = time.time_ns()

    async def run(self) -> None:
        """Run until `stop`; raises what only the operator can mend."""
        for note in self._config.notes:
            log.warning("%s", note)
        gc.freeze()  # what was imported stays: a look through all of it would cost tens of milliseconds
        self._reader.start()
        try:
            async with self._tasks:
                helpers = [
                    self._tasks.create_task(self._keep_reporting(), name="health"),
                    self._tasks.create_task(self._measuring.run(), name="decoding"),
                ]
                self._daemon.become(Condition.ONLINE, "measuring", self._started_utc_ns)
                self._sensor.no_frames("the link is being opened")
                if self._config.name is not None:
                    self._begin_publishing(self._config.name)
                await self._consume()
                for helper in helpers:
                    helper.cancel()
                self._report_health()  # the last word on what was counted
                self._daemon.end()
                await self._outlet.close(wait_for_broker=self._fatal is not None)
        finally:
            await asyncio.to_thread(self._reader.stop)
            await asyncio.to_thread(self._recording.close)
        if self._fatal is not None:
            raise self._fatal

    def stop(self) -> None:
        """End `run`; from the event loop."""
        self._stopping = True
        self._arrived.set()

    @property
    def daemon_boot_id(self) -> str:
        return self._daemon_boot_id

    @property
    def link_account(self) -> LinkAccount:
        """Where the link's bytes and frames went."""
        return self._reader.account()

    @property
    def message_account(self) -> MessageAccount:
        """Where the messages went."""
        return self._outlet.account

    def _wake_from(self, loop: asyncio.AbstractEventLoop) -> Callable[[], None]:
        pending = False

        def arrived() -> None:
            nonlocal pending
            pending = False
            self._arrived.set()

        def wake() -> None:
            # One at a time: those of a loop that stalls would fill the pipe that signals come by, too.
            nonlocal pending
            if not pending:
                pending = True
                with contextlib.suppress(RuntimeError):  # the loop is closed: the service ended meanwhile
                    loop.call_soon_threadsafe(arrived)

        return wake

    def _begin_publishing(self, name: str) -> None:
        parts = DaemonParts(
            report_health=self._report_health,
            last_messages=self._outlet.last_messages,
            force_chain=self._force_chain,
            locate=self._reader.locate,
            streams=self._reporter.streams,
            set_rate=self._outlet.set_rate,
            settings_changed=self._settings_changed,
        )
        recording = RecordingCommands(self._config, name, self._recording)
        handlers = CommandHandlers(self._config, self._daemon_boot_id, parts, recording)
        self._outlet.begin(name, handlers.by_verb, self._daemon)
        self._tasks.create_task(self._outlet.run(), name="publishing")

    def _force_chain(self) -> ForceChain | None:
        online = self._link is not None and self._link.state == "online"
        return self._measuring.force_chain if online else None

    def _settings_changed(self, measurement: Measurement, limits_hz: Mapping[str, float]) -> None:
        self._reporter.measurement = measurement
        self._reader.wake_at(useful_together(self._config.plate, measurement))
        self._limits_hz = dict(limits_hz)
        self._say_info()

    def _make_offline(self, reason: str) -> State:
        return self._reporter.daemon_state(
            self._daemon.standing._replace(condition=Condition.OFFLINE, reason=reason, since_utc_ns=time.time_ns())
        )

    def _publish(self, topic: Topic[Any], message: Any) -> None:
        self._outlet.publish(topic, message)

    def _lost(self) -> Lost:
        loss = self._reader.lost
        return Lost(
            link_gap=loss.link_gap,
            damaged=loss.damaged,
            board_overflow=loss.board_overflow,
            host_overrun=loss.host_overrun,
            ring_overflow=loss.ring_overflow,
            publish_dropped=self._outlet.dropped,
        )

    async def _consume(self) -> None:
        while not self._stopping and self._fatal is None:
            await self._arrived.wait()
            self._arrived.clear()
            for count, arrival in enumerate(self._reader.take()):
                self._handle(arrival)
                if count % _TOGETHER == _TOGETHER - 1:
                    await asyncio.sleep(0)  # much has come at once: messages and signals must not wait for all of it
                    if self._stopping:
                        break
            await asyncio.sleep(0)

    def _handle(self, arrival: Arrival) -> None:
        match arrival:
            case SingleToneFrame() | ChannelisedFrame():
                self._measuring.measure(arrival)
            case Gap():
                log.debug(
                    "gap of %d frames before frame %d", arrival.loss.total, arrival.first_index + arrival.loss.total
                )
            case LinkChange():
                self._link = arrival
                self._say_link(arrival)
                if arrival.state != "online":
                    self._sensor.no_frames(f"link {arrival.state}: {arrival.reason}")
                self._silence.watch(arrival.state)
            case Outage():
                self._outage = arrival
                if self._link is not None:
                    self._say_link(self._link)
            case BoardOnline():
                self._adopt(arrival)
            case BoardRefused():
                self._refuse(arrival)
            case ReaderFailed():
                raise arrival.error
            case BoardSays():
                log.log(min(arrival.level, logging.ERROR), "board: %s", arrival.text)

    def _adopt(self, board: BoardOnline) -> None:
        """Take a board that counts; a boot that was not seen before has nothing in common with the past."""
        if not self._outlet.open:
            try:
                self._begin_publishing(plate_name(board.identity.serial_number))
            except ValueError as error:
                serial_number = board.identity.serial_number
                self._fatal = ConfigError(f"serial number {serial_number!r} {error}; set name in the configuration")
                return
        if board.boot_id != self._board_boot_id:
            self._boots += 1
        if self._board is None or not board.continues:
            self._board_boot_id = board.boot_id
            self._measuring.begin(board)
        self._board = board
        self._recording.name_board(board)
        self._reporter.board_boot_id = f"{board.boot_id:08x}"
        self._say_info()

    def _refuse(self, refused: BoardRefused) -> None:
        if self._board_boot_id is not None:
            return  # the right board was here before and may come back
        error = IncompatibleBoardError if refused.other_protocol else ConfigError
        self._fatal = error(*refused.problems)
        self._daemon.become(Condition.REFUSED, "; ".join(refused.problems), time.time_ns())

    def _say_daemon(self, standing: DaemonStanding) -> None:
        self._publish(STATE_DAEMON, self._reporter.daemon_state(standing))

    def _say_link(self, link: LinkChange) -> None:
        self._publish(STATE_LINK, self._reporter.link_state(link, self._outage, self._boots))

    def _say_sensor(self, condition: Condition, reason: str, since_utc_ns: int) -> None:
        self._publish(STATE_SENSOR, self._reporter.sensor_state(condition, reason, since_utc_ns))

    def _say_info(self) -> None:
        if self._board is not None:
            self._publish(INFO, self._reporter.info(self._board, self._limits_hz))

    async def _keep_reporting(self) -> None:
        while True:
            self._sensor.calibration(self._config.plate.calibration.expiry_note(datetime.now(UTC).date()))
            await asyncio.sleep(_HEALTH_S)
            self._report_health()

    def _report_health(self) -> Health:
        running = self._recording.current
        vitals = self._monitor.vitals(
            self.link_account,
            self.message_account,
            self._reader.clock_rate_ppm,
            self._measuring.frames_not_decoded,
            self._measuring.records_unusable,
            latency=self._measuring.latencies.info(),
            recording=recording_info(running) if running else None,
            commands=self._outlet.command_counts,
        )
        health = Health(**self._reporter.header(HEALTH), **vitals)
        self._publish(HEALTH, health)
        return health


def _what_is_read(plate: Plate) -> str:
    """Say what a sensor that is well does, and what it leaves in."""
    if plate.skin is not None:
        return "all sites are read"
    read = "site forces only"
    if plate.counter.kind == "single-tone":
        read += ": one captured tone per corner gives no field to decode"
    return read if plate.response else f"{read}; hysteresis and creep of the sites are not taken out: not calibrated"
