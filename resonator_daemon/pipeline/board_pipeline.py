"""What follows from each arrival of a board: states, readings, messages; live and from a recording alike."""

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from resonator_daemon.config import Config, Measurement
from resonator_daemon.forces.readings import ForceReading
from resonator_daemon.pipeline.control_requests import MeasureOver, Tare, parse_control
from resonator_daemon.pipeline.frame_timeout import CallLater, Silence
from resonator_daemon.pipeline.measuring import Measuring
from resonator_daemon.pipeline.reports import Reporter, utc_day
from resonator_daemon.pipeline.sensor_state import SensorState
from resonator_daemon.pipeline.surface_decoding import MakeSurfaceDecoding, SequentialDecoding
from resonator_daemon.plate import Plate
from resonator_daemon.publishing.payloads import Condition, Lost
from resonator_daemon.publishing.topics import INFO, STATE_LINK, STATE_SENSOR, Topic
from resonator_daemon.session.clock import Instant
from resonator_daemon.session.counters import FrameLoss
from resonator_daemon.session.frames import (
    Arrival,
    BoardLogLine,
    BoardOnline,
    ChannelisedFrame,
    ControlRequest,
    Gap,
    LinkChange,
    Outage,
    SingleToneFrame,
)

log = logging.getLogger(__name__)

_DAY_NS = 86_400 * 10**9

Publish = Callable[[Topic[Any], Any], None]


class BoardCourse:
    """Follows one board through any number of connections and boots; it reads no clock, what arrives brings its time.

    Parameters
    ----------
    config
    daemon_boot_id
        Of this run.
    publish
        Takes topic and message.
    publish_dropped
        Tells how many messages subscribers have missed.
    call_later
        Of the event loop; None where all time passes by what arrives, and by `pass_time`.
    make_decoding
        Makes what decodes the frames of a skin.
    is_late
        Returns whether a message about a window that ends at this instant is too late; it is skipped then. Always
        False for recordings, which have no age.

    Attributes
    ----------
    measuring
        Frames to messages.
    reporter
        Makes the messages.
    board
        That counts, or did last.
    link
        How it stands.
    frames
        That were measured.
    """

    def __init__(
        self,
        config: Config,
        daemon_boot_id: str,
        publish: Publish,
        publish_dropped: Callable[[], int] = lambda: 0,
        call_later: CallLater | None = None,
        make_decoding: MakeSurfaceDecoding = SequentialDecoding,
        is_late: Callable[[Instant], bool] = lambda _: False,
    ) -> None:
        self._plate = config.plate
        self._publish = publish
        self._publish_dropped = publish_dropped
        self.reporter = Reporter(config, daemon_boot_id, self._lost)
        self._sensor = SensorState(self._say_sensor, _what_is_read(config.plate))
        self.measuring = Measuring(config, self.reporter, self._sensor, publish, make_decoding, is_late)
        self._silence = Silence(self.measuring.end_contacts, call_later)
        self.board: BoardOnline | None = None
        self.link: LinkChange | None = None
        self.frames = 0
        self._outage: Outage | None = None
        self._board_boot_id: int | None = None
        self._boots = 0
        self._loss = FrameLoss()
        self._told_lost = Lost()  # as the last message has it
        self._told_loss = self._loss, 0, 0  # of what that was made
        self._arrived_utc_ns = 0  # of what arrived last: the same live and from a recording
        self._now_utc_ns = 0
        self._day = -1
        self._limits_hz: Mapping[str, float] = {}  # of topics whose rate a command has lowered

    def take(self, arrival: Arrival | list[SingleToneFrame]) -> None:
        """Do what follows from an arrival, or from adjacent frames; arrivals for the daemon alone are ignored."""
        match arrival:
            case list():
                self._arrive(arrival[0].gate_middle.utc_ns)
                self.report(arrival, self.measure(arrival))
            case SingleToneFrame():
                self.take([arrival])
            case ChannelisedFrame():
                self._arrive(arrival.gate_middle.utc_ns)
                self.measuring.measure(arrival)
                self.frames += 1
            case Gap():
                self._loss += arrival.loss
                next_index = arrival.first_index + arrival.loss.total
                log.debug("gap of %d frames before frame %d", arrival.loss.total, next_index)
            case LinkChange():
                self._arrive(arrival.utc_ns)
                self.link = arrival
                self._say_link(arrival)
                if arrival.state != "online":
                    self._sensor.no_frames(f"link {arrival.state}: {arrival.reason}", arrival.utc_ns)
                self._silence.watch(arrival.state, arrival.utc_ns)
            case Outage():
                self._outage = arrival
                if self.link is not None:
                    self._say_link(self.link)
            case BoardOnline():
                self._adopt(arrival)
            case ControlRequest():
                if refusal := self.apply_control(arrival.request):
                    log.warning("%s", refusal)
            case BoardLogLine():
                log.log(min(arrival.level, logging.ERROR), "board: %s", arrival.text)

    def measure(self, frames: Sequence[SingleToneFrame]) -> list[ForceReading]:
        """Measure adjacent frames; `report` is to follow for all of them."""
        return self.measuring.read(frames)

    def report(self, frames: Sequence[SingleToneFrame], readings: Sequence[ForceReading]) -> None:
        """Publish readings that end with one of these adjacent frames, and let the time of the frames pass."""
        first, start = frames[0].index, 0
        for reading in readings:
            end = reading.sequence - first + 1
            self.measuring.publish(reading, self._arrive_all(frames[start:end]))
            start = end
        if start < len(frames):
            self._arrive_all(frames[start:])
        self.frames += len(frames)

    def pass_time(self, utc_ns: int) -> None:
        """Take note of what time it is on the host that reads, or read, the board."""
        self._now_utc_ns = utc_ns
        self._silence.passed(utc_ns)
        day = utc_ns // _DAY_NS
        if day != self._day:
            self._day = day
            self._sensor.calibration(self._plate.calibration.expiry_note(utc_day(utc_ns)), utc_ns)

    def _arrive_all(self, frames: Sequence[SingleToneFrame]) -> Instant:
        """Let the time of adjacent frames pass; return the middle of the last gate."""
        middle = frames[-1].gate_middle
        if middle.utc_ns // _DAY_NS != self._day:
            for frame in frames[:-1]:
                self._arrive(frame.gate_middle.utc_ns)
        self._arrive(middle.utc_ns)
        return middle

    def _arrive(self, utc_ns: int) -> None:
        self._arrived_utc_ns = utc_ns
        self.pass_time(utc_ns)

    def apply_control(self, request: str) -> str:
        """Apply a control request; return why it was refused, "" where it was applied."""
        try:
            match parse_control(request):
                case MeasureOver(measurement=measurement):
                    self._measure_over(measurement)
                    return ""
                case Tare():
                    chain = self.measuring.force_chain
                    return chain.tare() if chain is not None else "no force sites are being measured"
        except ValueError as error:
            return f"{request!r} is no order of this version: {error}"

    def _measure_over(self, measurement: Measurement) -> None:
        self.measuring.set_measurement(measurement)
        self.reporter.measurement = measurement
        self._say_info()

    def limit_rates(self, limits_hz: Mapping[str, float]) -> None:
        """Say how often topics are published whose rate was lowered."""
        self._limits_hz = dict(limits_hz)
        self._say_info()

    def allow(self, verbs: Collection[str]) -> None:
        """Say which commands are obeyed from now on."""
        self.reporter.allowed = verbs
        self._say_info()

    def close(self) -> None:
        """Forget what was to be told later."""
        self._silence.stop()

    def _adopt(self, board: BoardOnline) -> None:
        """Take a board that counts; a boot that was not seen before has nothing in common with the past."""
        if board.boot_id != self._board_boot_id:
            self._boots += 1
        if self.board is None or not board.continues:
            self._board_boot_id = board.boot_id
            self.measuring.begin(board)
        self.board = board
        self.reporter.board_boot_id = f"{board.boot_id:08x}"
        self._say_info()

    def _lost(self) -> Lost:
        loss, dropped, late = told = self._loss, self._publish_dropped(), self.measuring.skipped_late
        if told != self._told_loss:  # hundreds of messages a second have nothing new to say
            self._told_loss = told
            self._told_lost = Lost(
                link_gap=loss.link_gap,
                damaged=loss.damaged,
                board_overflow=loss.board_overflow,
                host_overrun=loss.host_overrun,
                ring_overflow=loss.ring_overflow,
                publish_dropped=dropped,
                skipped_late=late,
            )
        return self._told_lost

    def _say_link(self, link: LinkChange) -> None:
        self._publish(STATE_LINK, self.reporter.link_state(link, self._outage, self._boots))

    def _say_sensor(self, condition: Condition, reason: str, since_utc_ns: int) -> None:
        state = self.reporter.sensor_state(condition, reason, since_utc_ns, self._now_utc_ns)
        self._publish(STATE_SENSOR, state)

    def _say_info(self) -> None:
        if self.board is not None:
            self._publish(INFO, self.reporter.info(self.board, self._limits_hz, self._arrived_utc_ns))


def _what_is_read(plate: Plate) -> str:
    """Say what a sensor that is well does, and what it leaves in."""
    if plate.skin is not None:
        return "all sites are read"
    read = "site forces only"
    if plate.counter.kind == "single-tone":
        read += ": one captured tone per corner gives no field to decode"
    return read if plate.response else f"{read}; hysteresis and creep of the sites are not taken out: not calibrated"
