"""The daemon for one board: the only place where acquisition, measurement, decoding and publishing are joined."""

import asyncio
import gc
import logging
import math
import os
import secrets
import signal
import sys
import time
from collections.abc import Coroutine
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from resonator_daemon.base.errors import ConfigurationError, IncompatibleBoardError, UserError
from resonator_daemon.base.host.files import runtime_directory
from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.base.host.state_log import StateLog
from resonator_daemon.base.host.systemd import ServiceManager, tag_log
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config import Config
from resonator_daemon.board.config.tables import plate_name
from resonator_daemon.board.recording.event_replay import replay_of
from resonator_daemon.board.recording.switch import RecordingSwitch
from resonator_daemon.board.session.board_reader import BoardReader
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import (
    Arrival,
    BoardOnline,
    BoardRefused,
    ControlRequest,
    Frame,
    LinkChange,
    LinkCounters,
    ReaderFailed,
)
from resonator_daemon.board.session.link_state import all_of
from resonator_daemon.daemon.monitoring.liveness import DECLARED_WAITING, LivenessMonitor
from resonator_daemon.daemon.monitoring.metrics import MetricsServer
from resonator_daemon.daemon.monitoring.status import BrokerStatus, Status, StatusMonitor
from resonator_daemon.daemon.monitoring.status_server import SOCKET_NAME, AlreadyRunningError, StatusServer
from resonator_daemon.daemon.service.arrival_loop import ArrivalLoop
from resonator_daemon.daemon.service.command_handlers import CommandHandlers
from resonator_daemon.daemon.service.config_store import ConfigStore
from resonator_daemon.daemon.service.plate_publisher import PlatePublisher
from resonator_daemon.daemon.service.recordings import RecordedMessages, RecordingCommands, as_json_text, recording_info
from resonator_daemon.measure.pipeline.board_pipeline import BoardPipeline
from resonator_daemon.measure.pipeline.control_requests import ControlRequests, SetWindow
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.daemon_state import DaemonSnapshot, DaemonState
from resonator_daemon.mqtt.payloads import Condition, Health, Message, State
from resonator_daemon.mqtt.topics import HEALTH, STATE_DAEMON, STATE_LINK, STATE_SENSOR, Topic

if TYPE_CHECKING:
    from resonator_daemon.measure.decoder_process.supervisor import DecoderSupervisor
    from resonator_daemon.measure.sensors.surface_decoding import SurfaceClient
    from resonator_daemon.measure.sensors.surface_requests import SurfaceSettings

log = logging.getLogger(__name__)

_HEALTH_S = 1.0
_SWITCH_S = 5e-4  # of the reader thread, before the event loop has its turn; Python's 5 ms are half a frame
_WATCH_S = 1.0  # readiness is reported soon after the first frame, and a status is never old
_FRAMES_WAITING_S = 2.0
_FRAME_OVERHEAD_BYTES = 500  # by which a frame takes more memory than bytes on the wire
_LATE_NS = 75_000_000  # after its window, a message is skipped if a newer one can be made
_TOO_LATE_NS = 400_000_000  # in any case


async def serve(store: ConfigStore) -> None:
    """Measure and publish until SIGINT or SIGTERM; SIGHUP has the configuration read again.

    Raises
    ------
    UserError
        No configuration can be used, or the first board on the link can never serve it.
    """
    service = Service(store)
    sys.setswitchinterval(_SWITCH_S)
    with on_signals(service.on_signal):
        await service.run()


class Service:
    """One board from its bytes to its messages."""

    def __init__(self, store: ConfigStore) -> None:
        self._monitor = StatusMonitor()
        self._store = store
        config = store.load().config
        self._file_stem = store.path.stem
        self._instance = as_json_text(self._file_stem)
        loop = asyncio.get_running_loop()
        self._over: asyncio.Future[None] = loop.create_future()  # done when nothing more is to be measured
        self._recording = RecordingSwitch()
        self.daemon_boot_id = secrets.token_hex(4)
        self._decoder: DecoderSupervisor[Any] | None = None
        self._plate_publisher = PlatePublisher(config, self.daemon_boot_id, self._make_offline)
        self._pipeline = BoardPipeline(
            config,
            self.daemon_boot_id,
            self._publish,
            self._plate_publisher.losses,
            loop.call_later,
            self._make_decoder,
            is_late=self._is_late,
        )
        self._arrivals = ArrivalLoop(
            lambda: self._reader.pop_arrivals(), self._handle, self._plate_publisher.batch, self._over
        )
        frames_waiting = math.ceil(_FRAMES_WAITING_S * config.plate.counter.frame_rate_hz)
        self._reader = BoardReader(
            config.link,
            config.plate,
            self._arrivals.wake,
            step_frames=self._pipeline.sensor.wake_frames,
            frame_queue_bytes=frames_waiting * (config.plate.frame_bytes + _FRAME_OVERHEAD_BYTES),
            on_event=self._recording.put,
            replay=replay_of(config.link, config.plate),
        )
        self._control_requests = ControlRequests(self._reader.request_control)
        self._recorded = RecordedMessages(self._recording.publish, include_messages=config.recording.include_messages)
        self._recordings: RecordingCommands | None = None
        self._step_ns = round(1e9 * self._pipeline.sensor.step_s)
        self._tasks = asyncio.TaskGroup()
        self._state_logs = {STATE_DAEMON: StateLog("daemon", log), STATE_SENSOR: StateLog("sensor", log)}
        self._daemon = DaemonState(self.daemon_boot_id, self._publish_daemon_state, self._plate_publisher.restore_now)
        self._version = version("resonatord")  # asked for once: it is in a file
        self._manager = ServiceManager()
        self._liveness = LivenessMonitor()
        self._health: Health | None = None  # as reported last
        self._name = config.name
        self._reload_requested = asyncio.Event()
        self._ready = False
        self._fatal: UserError | None = None
        self._started_utc_ns = time.time_ns()
        self._reason: Reason | None = None  # of state/daemon
        socket = runtime_directory(self._file_stem) / SOCKET_NAME
        self._status_server = StatusServer(socket, store.path, self._status)

    async def run(self) -> None:
        """Run until `stop`; raises UserError."""
        for note in self._store.config.notes:
            log.warning("%s", note)
        gc.freeze()  # what was imported stays: a look through all of it would cost tens of milliseconds
        try:
            async with self._tasks:
                helpers = {name: self._tasks.create_task(work, name=name) for name, work in self._helpers().items()}
                if await self._may_begin():
                    self._publish_measuring()
                    if (name := self._store.config.name) is not None:
                        await self._keep_recording(self._begin_publishing(name))  # from the first byte on
                    self._reader.start()
                await self._over
                self._manager.stopping()
                for helper in helpers.values():
                    helper.cancel()
                await asyncio.wait([helpers["decoding"]])
                self._pipeline.sensor.end_contacts(Reason(ReasonCode.STOPPED, "the daemon stopped"))
                self._report_health()  # the last word on what was counted
                self._daemon.end()
                await self._plate_publisher.close(wait_for_broker=self._fatal is not None)
        finally:
            self._pipeline.close()
            await asyncio.to_thread(self._reader.stop)
            self._arrivals.close()
            await asyncio.to_thread(self._recording.stop)
        if self._fatal is not None:
            raise self._fatal

    def on_signal(self, number: signal.Signals) -> None:
        """Read the configuration again upon SIGHUP, and end upon others; from the event loop."""
        if number is signal.SIGHUP:
            self.reload()
        else:
            self.stop(f"ended by {number.name}")

    def stop(self, why: str = "ended") -> None:
        """End `run`; from the event loop."""
        if not self._over.done():
            log.info("%s", why)
        self._end()

    def _end(self, fatal: UserError | None = None) -> None:
        self._fatal = fatal or self._fatal
        if not self._over.done():
            self._over.set_result(None)

    def reload(self) -> None:
        """Read the configuration again, and take what can change while all goes on; from the event loop."""
        self._reload_requested.set()

    @property
    def link_counters(self) -> LinkCounters:
        """Where the link's bytes and frames went."""
        return self._reader.counters()

    def _begin_publishing(self, name: str) -> RecordingCommands:
        self._name = self._pipeline.headers.name = name
        tag_log(name)
        recordings = RecordingCommands(
            self._store.config,
            name,
            self._recording,
            daemon_boot_id=self.daemon_boot_id,
            config_sha256=self._store.sha256,
        )
        handlers = CommandHandlers(
            self._store.config,
            self.daemon_boot_id,
            recordings,
            pipeline=self._pipeline,
            publisher=self._plate_publisher,
            daemon=self._daemon,
            reader=self._reader,
            requests=self._control_requests,
        )
        self._plate_publisher.begin(name, handlers.by_verb, self._daemon)
        self._tasks.create_task(self._plate_publisher.run(), name="publishing")
        self._recordings = recordings
        return recordings

    async def _keep_recording(self, recordings: RecordingCommands) -> None:
        try:
            await recordings.keep_recording()
        except UserError as error:
            log.error("nothing is recorded: %s", error)

    async def _keep_reloading(self) -> None:
        while True:
            await self._reload_requested.wait()
            self._reload_requested.clear()  # the file may change again while it is read
            self._manager.reloading()
            found = await self._store.reload()
            if found is not None and found.live:
                await self._adopt(self._store.config, found.live)
            self._publish_measuring()
            if self._ready:
                self._manager.ready(self._sentence())

    async def _adopt(self, config: Config, changed: tuple[str, ...]) -> None:
        """Use the values of keys that were changed."""
        if any(key.startswith("measurement.") for key in changed):
            await self._control_requests.apply(SetWindow(measurement=config.measurement))
        self._pipeline.allow(config.commands.allow)
        self._plate_publisher.set_allowed(config.commands.allow)
        self._recorded.include_messages = config.recording.include_messages
        if self._recordings is not None:
            await self._recordings.adopt(config, self._store.sha256)

    def _make_offline(self, reason: Reason) -> State:
        now_ns = time.time_ns()
        snapshot = self._daemon.snapshot._replace(condition=Condition.OFFLINE, reason=reason, since_utc_ns=now_ns)
        return snapshot.message(self._pipeline.headers.of(STATE_DAEMON, now_ns))

    def _is_late(self, gate_middle: Instant) -> bool:
        """Return whether a message about this instant is late, and a newer one can be made, or it is far too late."""
        age_ns = time.monotonic_ns() - gate_middle.monotonic_ns
        if age_ns <= _LATE_NS or self._reader.replays:
            return False
        newer_ns = self._reader.queue.newest_middle_ns - gate_middle.monotonic_ns
        return newer_ns >= self._step_ns or age_ns > _TOO_LATE_NS

    def _handle(self, arrival: Arrival | list[Frame]) -> None:
        match arrival:
            case list():
                pass  # by far the most frequent: frames
            case BoardOnline() if not self._plate_publisher.open and not self._use_serial_number(arrival):
                return
            case BoardOnline():
                self._recording.name_board(arrival)
            case BoardRefused():
                self._refuse(arrival)
            case ControlRequest():
                self._control_requests.applied(arrival.key, self._pipeline.apply(arrival.request))
                self._reader.queue.step_frames = self._pipeline.sensor.wake_frames
                self._step_ns = round(1e9 * self._pipeline.sensor.step_s)
                return
            case ReaderFailed():
                raise arrival.error
        self._pipeline.handle(arrival)
        if isinstance(arrival, LinkChange) and not self._over.done():
            self._publish_measuring()

    def _use_serial_number(self, board: BoardOnline) -> bool:
        """Publish under the board's serial number; return whether that can be."""
        serial_number = board.identity.serial_number
        try:
            recordings = self._begin_publishing(plate_name(serial_number))
        except ValueError as error:
            why = f"serial number {serial_number!r} {error}; set name in the configuration"
            self._end(ConfigurationError(why))
            return False
        self._tasks.create_task(self._keep_recording(recordings), name="recording")
        return True

    def _refuse(self, refused: BoardRefused) -> None:
        if self._pipeline.board is not None:
            return  # the right board was here before and may come back
        error = IncompatibleBoardError if refused.other_protocol else ConfigurationError
        self._end(error(*(problem.text for problem in refused.problems)))
        self._daemon.become(Condition.REFUSED, all_of(refused.problems), time.time_ns())

    def _make_decoder(self, settings: "SurfaceSettings", client: "SurfaceClient[Any]") -> "DecoderSupervisor[Any]":
        from resonator_daemon.measure.decoder_process.supervisor import DecoderSupervisor  # here: only a skin needs it

        self._decoder = DecoderSupervisor(settings, client, self._store.config.name or self._file_stem)
        return self._decoder

    def _publish(self, topic: Topic[Any], message: Message | Encoded) -> None:
        if (state_log := self._state_logs.get(topic)) is not None and isinstance(message, State):
            reason = Reason(message.reason_code or ReasonCode.UNSPECIFIED, message.reason)
            state_log.write(message.state, reason)
        self._plate_publisher.publish(topic, message)
        self._recorded.record(topic, message)

    def _publish_daemon_state(self, snapshot: DaemonSnapshot) -> None:
        self._publish(STATE_DAEMON, snapshot.message(self._pipeline.headers.of(STATE_DAEMON, time.time_ns())))

    def _publish_measuring(self) -> None:
        """Publish the state of the daemon where its reason is another one than before."""
        link = self._pipeline.link
        measuring = link is not None and link.state == Condition.ONLINE
        no_board = Reason(ReasonCode.NO_BOARD, "no board sends frames")
        now = Reason(ReasonCode.MEASURING, "measuring") if measuring else no_board
        reason = all_of(filter(None, (self._store.remark, now)))
        if reason != self._reason:
            self._reason = reason
            self._daemon.become(Condition.ONLINE, reason, self._started_utc_ns)

    def _helpers(self) -> dict[str, Coroutine[Any, Any, None]]:
        """Return what runs concurrently with the reading of the board, by name, until cancelled."""
        helpers = {
            "health": self._keep_reporting(),
            "decoding": self._pipeline.sensor.run(),
            "watchdog": self._keep_watch(),
            "reloading": self._keep_reloading(),
            "status": self._answer_status(self._status_server),
        }
        if (listen := self._store.config.metrics.listen) is not None:
            helpers["metrics"] = MetricsServer(listen, self._status).run()
        return helpers

    async def _may_begin(self) -> bool:
        """Wait until no other daemon runs with this configuration file; return False if this one is to end before."""
        waiting: asyncio.Future[bool] = asyncio.create_task(self._status_server.may_begin.wait())
        either: list[asyncio.Future[Any]] = [waiting, self._over]
        await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        return not self._over.done()

    async def _answer_status(self, server: StatusServer) -> None:
        try:
            await server.run()
        except AlreadyRunningError as error:
            self._end(error)

    async def _keep_watch(self) -> None:
        """Report readiness and liveness to the service manager."""
        while True:
            link = self._pipeline.link
            state = link.state if link is not None else Condition.STARTING
            if not self._ready and (self._pipeline.frames or state in DECLARED_WAITING):
                self._ready = True
                self._manager.ready(self._sentence())
            if self._liveness.healthy(self._pipeline.frames, state, self._reader.turns):
                self._manager.alive()
            self._manager.status(self._sentence())
            self._reader.flush_log()
            for state_log in self._state_logs.values():
                state_log.flush()
            await asyncio.sleep(min(_WATCH_S, self._manager.watchdog_s or _WATCH_S))

    def _sentence(self) -> str:
        """Return the status line."""
        link, health = self._pipeline.link, self._health
        state = f"link {link.state}: {link.reason.text}" if link is not None else "starting"
        if link is not None and link.state == Condition.ONLINE and health is not None:
            lost = sum(health.lost.model_dump(exclude={"skipped_late"}).values())
            state = f"{health.frame_rate_hz:.0f} frames/s, {lost} lost"
        remark = self._store.remark
        return f"{self._name or self._instance}: {state}" + (f"; {remark.text}" if remark is not None else "")

    def _status(self) -> Status:
        """Return how all of this is, for programs on the same computer."""
        last, url = self._plate_publisher.last_message, self._store.config.mqtt.anonymous().url
        status = Status(
            name=self._name,
            instance=self._instance,
            pid=os.getpid(),
            version=self._version,
            started_t_ns=self._started_utc_ns,
            config=self._store.status,
            daemon=last(STATE_DAEMON.path),
            link=last(STATE_LINK.path),
            sensor=last(STATE_SENSOR.path),
            health=self._health,
            broker=BrokerStatus(url=url, connected=self._plate_publisher.connected),
            recording=recording_info(self._recording),
        )
        return self._monitor.with_ages(status)

    async def _keep_reporting(self) -> None:
        while True:
            await asyncio.sleep(_HEALTH_S)
            self._health = self._report_health()
            self._status()  # so that the age of what is new is counted from now on, asked for or not

    def _report_health(self) -> Health:
        health = self._monitor.health(
            self._pipeline.headers.of(HEALTH, time.time_ns()),
            self.link_counters,
            self._reader.load,
            self._decoder.info() if self._decoder is not None else None,
            messages=self._plate_publisher.account,
            clock_drift_ppm=self._reader.clock_rate_ppm,
            sites_suspect=len(self._pipeline.sensor.suspect_sites),
            records_unusable=self._pipeline.sensor.records_unusable,
            latency=self._pipeline.output.latencies.info(),
            recording=recording_info(self._recording),
            commands=self._plate_publisher.command_counts,
        )
        self._publish(HEALTH, health)
        return health
