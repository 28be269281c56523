"""The daemon for one board: the only place where acquisition, measurement, decoding and publishing are joined."""

import asyncio
import contextlib
import gc
import logging
import secrets
import signal
import time
from collections.abc import Callable
from typing import Any

from resonator_daemon.acquisition.board import BoardReader
from resonator_daemon.acquisition.clock import Instant
from resonator_daemon.acquisition.fit import oscillator_hz
from resonator_daemon.acquisition.frames import (
    Arrival,
    BoardOnline,
    BoardRefused,
    BoardSays,
    ChannelisedFrame,
    Gap,
    LinkAccount,
    LinkChange,
    ReaderFailed,
    SingleToneFrame,
)
from resonator_daemon.config import Config, SerialLink, topic_level
from resonator_daemon.decoding.skin import Skin, Wanted
from resonator_daemon.decoding.skin_decoder import SurfaceReading
from resonator_daemon.decoding.stage import DecodingStage
from resonator_daemon.elastic import HalfSpace
from resonator_daemon.errors import ConfigError, IncompatibleBoardError, OperatorError
from resonator_daemon.health import HealthMonitor
from resonator_daemon.measurement.chain import ChannelisedChain, ChannelisedReading, SingleToneChain, SingleToneReading
from resonator_daemon.publishing.payloads import Condition, Health, Lost, MessageAccount, State
from resonator_daemon.publishing.publisher import Publisher
from resonator_daemon.publishing.topics import (
    CONTACT_EVENT,
    CONTACTS,
    DECODED,
    DECODED_SUMMARY,
    FORCES,
    HEALTH,
    INFO,
    SIGNALS,
    STATE_DAEMON,
    STATE_LINK,
    STATE_SENSOR,
    Topic,
)
from resonator_daemon.reports import Reporter
from resonator_daemon.sensor_state import SensorState

log = logging.getLogger(__name__)

_HEALTH_S = 1.0
_NO_MESSAGES = MessageAccount(
    made=0, restored=0, acknowledged=0, handed_to_socket=0, dropped=0, unknown_at_disconnect=0, waiting=0
)


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
    await service.run()


class Service:
    """One board from its bytes to its messages."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._arrived = asyncio.Event()
        gate_s = 1 / config.plate.counter.frame_rate_hz
        single_tone = config.plate.counter.kind == "single-tone"
        self._step_frames = round(config.measurement.step_s / gate_s) if single_tone else 1
        wake = self._wake_from(asyncio.get_running_loop())
        self._reader = BoardReader(config.link, config.plate, wake, step_frames=self._step_frames)
        self._daemon_boot_id = secrets.token_hex(8)
        self._reporter = Reporter(config, self._daemon_boot_id, self._lost)
        self._publisher: Publisher | None = None
        self._tasks = asyncio.TaskGroup()
        self._monitor = HealthMonitor()
        self._sensor = SensorState(self._set_sensor, site_forces_only=single_tone)
        self._states: dict[Topic[State], State] = {}
        self._single_tone: SingleToneChain | None = None
        self._channelised: ChannelisedChain | None = None
        self._stage = self._make_stage()
        self._board_boot_id: int | None = None
        self._last_forces: tuple[SingleToneReading, Instant] | None = None
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
                helpers = [self._tasks.create_task(self._report_health(), name="health")]
                if self._stage is not None:
                    helpers.append(self._tasks.create_task(self._stage.run(), name="decoding"))
                if self._config.name is not None:
                    self._begin_publishing(self._config.name)
                self._set_state(STATE_DAEMON, Condition.ONLINE, "measuring", self._started_utc_ns)
                self._sensor.no_frames("the link is being opened")
                await self._consume()
                for helper in helpers:
                    helper.cancel()
                self._publish_health()  # the last word on what was counted
                if self._publisher is not None:
                    await self._publisher.close(wait_for_broker=self._fatal is not None)
        finally:
            await asyncio.to_thread(self._reader.stop)
        if self._fatal is not None:
            raise self._fatal

    def stop(self) -> None:
        """End `run`; from the event loop."""
        self._stopping = True
        self._arrived.set()

    @property
    def link_account(self) -> LinkAccount:
        """Where the link's bytes and frames went."""
        return self._reader.account()

    @property
    def message_account(self) -> MessageAccount:
        """Where the messages went."""
        return self._publisher.account if self._publisher is not None else _NO_MESSAGES

    def _wake_from(self, loop: asyncio.AbstractEventLoop) -> Callable[[], None]:
        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed: the service ended meanwhile
                loop.call_soon_threadsafe(self._arrived.set)

        return wake

    def _begin_publishing(self, name: str) -> None:
        self._publisher = Publisher(self._config.mqtt, name, self._make_offline)
        for topic, state in self._states.items():
            self._publisher.publish(topic, state)
        self._tasks.create_task(self._publisher.run(), name="publishing")

    def _make_offline(self, reason: str) -> State:
        return self._reporter.state(STATE_DAEMON, Condition.OFFLINE, reason, time.time_ns())

    def _publish(self, topic: Topic[Any], message: Any) -> None:
        if self._publisher is not None:
            self._publisher.publish(topic, message)

    def _lost(self) -> Lost:
        loss = self._reader.lost
        return Lost(
            link_gap=loss.link_gap,
            damaged=loss.damaged,
            board_overflow=loss.board_overflow,
            host_overrun=loss.host_overrun,
            publish_dropped=self._publisher.dropped if self._publisher is not None else 0,
        )

    async def _consume(self) -> None:
        while not self._stopping and self._fatal is None:
            await self._arrived.wait()
            self._arrived.clear()
            for arrival in self._reader.take():
                self._handle(arrival)

    def _handle(self, arrival: Arrival) -> None:
        match arrival:
            case SingleToneFrame():
                self._measure_forces(arrival)
            case ChannelisedFrame():
                self._measure_signals(arrival)
            case Gap():
                log.debug(
                    "gap of %d frames before frame %d", arrival.loss.total, arrival.first_index + arrival.loss.total
                )
            case LinkChange():
                self._set_state(STATE_LINK, Condition(arrival.state), arrival.reason, arrival.since_utc_ns)
                if arrival.state != "online":
                    self._sensor.no_frames(f"link {arrival.state}: {arrival.reason}")
            case BoardOnline():
                self._adopt(arrival)
            case BoardRefused():
                self._refuse(arrival)
            case ReaderFailed():
                raise arrival.error
            case BoardSays():
                log.log(arrival.level, "board: %s", arrival.text)

    def _adopt(self, board: BoardOnline) -> None:
        """Take a board that counts; a boot that was not seen before has nothing in common with the past."""
        if self._publisher is None:
            try:
                self._begin_publishing(topic_level(board.identity.serial_number))
            except ValueError as error:
                serial_number = board.identity.serial_number
                self._fatal = ConfigError(f"serial number {serial_number!r} {error}; set name in the configuration")
                return
        if self._board_boot_id != board.boot_id:
            self._board_boot_id = board.boot_id
            self._begin_measuring(board)
        self._reporter.board_boot_id = f"{board.boot_id:08x}"
        self._publish(INFO, self._reporter.info(board, _link_text(self._config)))

    def _begin_measuring(self, board: BoardOnline) -> None:
        if self._single_tone is not None and self._last_forces is not None:
            for event in self._single_tone.restart():
                self._publish(CONTACT_EVENT, self._reporter.event(event, *self._last_forces))
            return
        plate, tones = self._config.plate, self._config.plate.tones
        gate_s = 1 / plate.counter.frame_rate_hz
        if plate.counter.kind == "single-tone":
            measurement = self._config.measurement
            self._single_tone = SingleToneChain(
                tones.f0_hz,
                tones.sensitivity,
                plate.site_positions_m,
                plate.outline_m,
                force_max_newton=plate.force_max_newton,
                pilot_hz=plate.pilot_hz,
                reference_hz=plate.counter.reference_hz,
                gate_s=gate_s,
                window_frames=round(measurement.window_s / gate_s),
                step_frames=self._step_frames,
                load_sharing_exponent=plate.load_sharing_exponent,
            )
        elif plate.skin is not None:
            self._channelised = ChannelisedChain(
                tones.f0_hz,
                tones.sensitivity,
                oscillator_hz(board.description),
                tones.site_index,
                tones.signal_index,
                youngs_modulus_pascal=plate.skin.youngs_modulus_pascal,
                gate_s=gate_s,
            )

    def _refuse(self, refused: BoardRefused) -> None:
        if self._board_boot_id is not None:
            return  # the right board was here before and may come back
        error = IncompatibleBoardError if refused.other_protocol else ConfigError
        self._fatal = error(*refused.problems)
        self._set_state(STATE_DAEMON, Condition.REFUSED, "; ".join(refused.problems), time.time_ns())

    def _measure_forces(self, frame: SingleToneFrame) -> None:
        if self._single_tone is None:
            return
        reading = self._single_tone.push(frame.index, frame.board_ticks, frame.records)
        if reading is None:
            return
        self._last_forces = (reading, frame.gate_end)
        self._sensor.update(reading.status, reading.reason, reading.common_mode, frame.gate_end.utc_ns)
        for event in reading.events:
            self._publish(CONTACT_EVENT, self._reporter.event(event, reading, frame.gate_end))
        self._publish(FORCES, self._reporter.forces(reading, frame.gate_end))
        self._publish(CONTACTS, self._reporter.contacts(reading, frame.gate_end))

    def _measure_signals(self, frame: ChannelisedFrame) -> None:
        if self._channelised is None:
            return
        reading = self._channelised.push(
            frame.index, frame.board_ticks, frame.offset_hz16, frame.sigma_code, frame.known
        )
        self._sensor.update(reading.status, reading.reason, (reading.common_mode,), frame.gate_end.utc_ns)
        self._publish(SIGNALS, self._reporter.signals(reading, frame.gate_end))
        if self._stage is not None and reading.status == "ok":
            self._stage.offer((reading, frame.gate_end), reading.signals, reading.noise_std)

    def _make_stage(self) -> DecodingStage[tuple[ChannelisedReading, Instant]] | None:
        skin, wanted = self._config.plate.skin, self._config.decoding
        if skin is None:
            return None
        if wanted.method == "off":
            self._sensor.explain("decoding is off")
            return None
        half_space = HalfSpace(skin.youngs_modulus_pascal, skin.poisson_ratio)
        return DecodingStage(
            Skin(
                half_space,
                self._config.plate.site_positions_m,
                skin.depth_m,
                skin.gain_std,
                skin.correlation_length_m,
                skin.tangential_ratio,
            ),
            Wanted(wanted.method, wanted.contact_physics, wanted.friction_coefficient),
            self._decoded,
            self._sensor.explain,
        )

    def _decoded(self, origin: tuple[ChannelisedReading, Instant], surface: SurfaceReading) -> None:
        for event in surface.events:
            self._publish(CONTACT_EVENT, self._reporter.skin_event(event, *origin))
        self._publish(DECODED, self._reporter.decoded(*origin, surface.decoded))
        self._publish(DECODED_SUMMARY, self._reporter.summary(*origin, surface))
        self._publish(CONTACTS, self._reporter.skin_contacts(*origin, surface))

    def _set_state(self, topic: Topic[State], condition: Condition, reason: str, since_utc_ns: int) -> None:
        state = self._reporter.state(topic, condition, reason, since_utc_ns)
        self._states[topic] = state
        self._publish(topic, state)

    def _set_sensor(self, condition: Condition, reason: str, since_utc_ns: int) -> None:
        self._set_state(STATE_SENSOR, condition, reason, since_utc_ns)

    async def _report_health(self) -> None:
        while True:
            await asyncio.sleep(_HEALTH_S)
            self._publish_health()

    def _publish_health(self) -> None:
        if self._publisher is None:
            return
        vitals = self._monitor.vitals(
            self.link_account,
            self.message_account,
            self._reader.clock_rate_ppm,
            self._stage.frames_skipped if self._stage is not None else 0,
            dict(self._single_tone.unusable) if self._single_tone is not None else {},
        )
        self._publish(HEALTH, Health(**self._reporter.header(HEALTH), **vitals))


def _link_text(config: Config) -> str:
    link = config.link
    return f"serial:{link.path}?baud={link.baud}" if isinstance(link, SerialLink) else f"tcp://{link.host}:{link.port}"
