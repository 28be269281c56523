"""Events of a board's session to messages, without a clock: live, from a recording, and wherever else they are read."""

import logging
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Final, Protocol

from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.config import Config
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import (
    Arrival,
    BoardLogLine,
    BoardOnline,
    ChannelisedFrame,
    ControlRequest,
    Frame,
    FrameLoss,
    Gap,
    LinkChange,
    Outage,
    SingleToneFrame,
)
from resonator_daemon.estimate.forces.readings import Compensation, ForceReading, SkinReading
from resonator_daemon.measure.pipeline.control_requests import SetWindow, Tare, parse_request
from resonator_daemon.measure.pipeline.state_messages import StateMessages
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.measure.sensors.output import DAY_NS, MessageOutput, Publish, SensorState, utc_day
from resonator_daemon.mqtt.payloads import Lost
from resonator_daemon.mqtt.topics import INFO, STATE_LINK, STATE_SENSOR, Headers

CONTACTS_END_S: Final = 0.5  # as long as a contact of which nothing is known is kept while frames do come


class Timer(Protocol):
    """A scheduled call."""

    def cancel(self) -> None: ...


CallLater = Callable[[float, Callable[[], None]], Timer]


class FrameTimeout:
    """Calls back once if the link has not been online for half a second.

    Parameters
    ----------
    expire
        Called with the reason.
    call_later
        Of the event loop, for which the present counts; None if all time passes by `passed`.

    Attributes
    ----------
    due_utc_ns
        When it calls back, unless frames come; None while they do.
    """

    def __init__(self, expire: Callable[[Reason], None], call_later: CallLater | None) -> None:
        self._expire = expire
        self._call_later = call_later
        self._timer: Timer | None = None
        self.due_utc_ns: int | None = None
        self._waiting = False

    def watch(self, link_state: Condition, utc_ns: int) -> None:
        """Follow a change of the link's state."""
        self.passed(utc_ns)
        if link_state == Condition.ONLINE:
            self.stop()
        elif not self._waiting:
            self._waiting = True
            self.due_utc_ns = utc_ns + round(CONTACTS_END_S * 1e9)
            if self._call_later is not None:
                self._timer = self._call_later(CONTACTS_END_S, self._run_out)

    def passed(self, utc_ns: int) -> None:
        """End the contacts if the time limit has passed at this moment."""
        if self.due_utc_ns is not None and utc_ns >= self.due_utc_ns:
            self._run_out()

    def stop(self) -> None:
        """Stop waiting."""
        self._waiting = False
        self._end()

    def _run_out(self) -> None:
        self._end()
        self._expire(Reason(ReasonCode.NO_FRAMES, f"no frames for {CONTACTS_END_S:g} s"))

    def _end(self) -> None:
        self.due_utc_ns = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


if TYPE_CHECKING:
    from resonator_daemon.measure.sensors.surface_decoding import MakeSurfaceDecoding

log = logging.getLogger(__name__)


Reading = ForceReading | SkinReading


class BoardPipeline:
    """Follows one board through any number of connections and boots.

    It reads no clock: what arrives brings its time.

    Parameters
    ----------
    config
    daemon_boot_id
        Identifier of this run.
    publish
        Called with topic and message.
    publish_losses
        Returns the numbers of messages that were dropped, and that were skipped as late, behind `publish`.
    call_later
        Of the event loop; None if time passes by what arrives and by `pass_time` alone.
    make_decoding
        Makes what decodes the frames of a skin; None if each is decoded at once.
    is_late
        Returns whether a message about a window that ends at this instant is too late to be published. Always False
        for recordings, which have no age.

    Attributes
    ----------
    sensor
        Frames to messages.
    headers
        Makes the headers of messages.
    states
        Makes the messages about states.
    output
        Where the sensor's messages go.
    board
        The board that counts, or did last.
    link
        The last state of the link.
    frames
        Number of frames that were measured.
    """

    def __init__(
        self,
        config: Config,
        daemon_boot_id: str,
        publish: Publish,
        publish_losses: Callable[[], tuple[int, int]] = lambda: (0, 0),
        call_later: CallLater | None = None,
        make_decoding: "MakeSurfaceDecoding | None" = None,
        is_late: Callable[[Instant], bool] = lambda _: False,
    ) -> None:
        self._plate = config.plate
        self._publish = publish
        self._publish_losses = publish_losses
        self.headers = Headers(config.name or "", daemon_boot_id, self._lost)
        self.sensor = sensor_of(config.plate, config.measurement, config.decoding)
        self.states = StateMessages(config, self.sensor, self.headers)
        self._sensor_state = SensorState(self._publish_sensor_state, self.sensor.summary)
        self.output = MessageOutput(config, self.headers, self._sensor_state, publish, is_late)
        self.sensor.connect(self.output, make_decoding)
        self._frame_timeout = FrameTimeout(self.sensor.end_contacts, call_later)
        self.board: BoardOnline | None = None
        self.link: LinkChange | None = None
        self.frames = 0
        self._outage: Outage | None = None
        self._board_boot_id: int | None = None
        self._boots = 0
        self._loss = FrameLoss()
        self._last_lost = Lost()  # as in the last message
        self._last_loss = self._loss, (0, 0), 0  # of what that was made
        self._arrived_utc_ns = 0  # of what arrived last: the same live and from a recording
        self._now_utc_ns = 0
        self._day = -1

    @property
    def skipped_late(self) -> int:
        """Number of messages that were skipped because they were late."""
        return self.output.skipped_late + self.sensor.skipped_late

    def handle(self, arrival: Arrival | list[Frame]) -> None:
        """Publish what follows from an arrival, or from adjacent frames; events for the daemon alone are ignored."""
        match arrival:
            case list():
                if self._frame_timeout.due_utc_ns is not None:
                    self._arrive(arrival[0].gate_middle.utc_ns)
                self.publish(arrival, self.sensor.measure(arrival))
            case SingleToneFrame() | ChannelisedFrame():
                self.handle([arrival])
            case Gap():
                self._loss += arrival.loss
                next_index = arrival.first_index + arrival.loss.total
                log.debug("gap of %d frames before frame %d", arrival.loss.total, next_index)
            case LinkChange():
                self._arrive(arrival.utc_ns)
                self.link = arrival
                self._publish_link_state(arrival)
                if arrival.state != Condition.ONLINE:
                    no_frames = Reason(ReasonCode.NO_FRAMES, f"link {arrival.state}: {arrival.reason.text}")
                    self._sensor_state.no_frames(no_frames, arrival.utc_ns)
                self._frame_timeout.watch(arrival.state, arrival.utc_ns)
            case Outage():
                self._outage = arrival
                if self.link is not None:
                    self._publish_link_state(self.link)
            case BoardOnline():
                self._adopt(arrival)
            case ControlRequest():
                if (refusal := self.apply(arrival.request)) is not None:
                    log.warning("%s", refusal)
            case BoardLogLine():
                log.log(min(arrival.level, logging.ERROR), "board: %s", arrival.text)

    def publish(self, frames: Sequence[Frame], readings: Sequence[Reading]) -> None:
        """Publish the sensor's readings that end with one of these adjacent frames; let the time of the frames pass."""
        first, start = frames[0].index, 0
        for reading in readings:
            end = reading.sequence - first + 1
            self.sensor.publish(reading, self._pass_frames(frames[start:end]))
            start = end
        if start < len(frames):
            self._pass_frames(frames[start:])
        self.frames += len(frames)

    def pass_time(self, utc_ns: int) -> None:
        """Advance the time of the host that reads, or read, the board."""
        self._now_utc_ns = utc_ns
        if self._frame_timeout.due_utc_ns is not None:
            self._frame_timeout.passed(utc_ns)
        day = utc_ns // DAY_NS
        if day != self._day:
            self._day = day
            self._sensor_state.calibration(self._plate.calibration.expiry_note(utc_day(utc_ns)), utc_ns)

    def _pass_frames(self, frames: Sequence[Frame]) -> Instant:
        """Advance the time by adjacent frames; return the middle of the last gate."""
        middle = frames[-1].gate_middle
        utc_ns = middle.utc_ns
        if utc_ns // DAY_NS == self._day and self._frame_timeout.due_utc_ns is None:
            self._arrived_utc_ns = self._now_utc_ns = utc_ns
            return middle
        if utc_ns // DAY_NS != self._day:
            for frame in frames[:-1]:
                self._arrive(frame.gate_middle.utc_ns)
        self._arrive(utc_ns)
        return middle

    def _arrive(self, utc_ns: int) -> None:
        self._arrived_utc_ns = utc_ns
        self.pass_time(utc_ns)

    def apply(self, request: str) -> str | None:
        """Apply a control request; return why that cannot be done, None if it was done."""
        try:
            match parse_request(request):
                case SetWindow(measurement=measurement):
                    self.sensor.set_window(measurement)
                    self._publish_info()
                    return None
                case Tare():
                    return self.sensor.tare()
        except ValueError as error:
            return f"{request!r} is no request of this version: {error}"

    def allow(self, verbs: Collection[str]) -> None:
        """Publish which commands are accepted from now on."""
        self.states.allowed = verbs
        self._publish_info()

    def close(self) -> None:
        """Cancel what was to happen later."""
        self._frame_timeout.stop()

    def _adopt(self, board: BoardOnline) -> None:
        """Begin with a board that counts; a new boot has nothing in common with the past."""
        if board.boot_id != self._board_boot_id:
            self._boots += 1
        if self.board is None or not board.continues:
            self._board_boot_id = board.boot_id
            self.sensor.begin(board)
        self.board = board
        self.headers.name = self.headers.name or board.identity.serial_number
        self.headers.board_boot_id = f"{board.boot_id:08x}"
        self._publish_info()

    def _lost(self) -> Lost:
        loss, (dropped, late), skipped = now = self._loss, self._publish_losses(), self.skipped_late
        if now != self._last_loss:  # hundreds of messages a second repeat the last one
            self._last_loss = now
            self._last_lost = Lost(
                link_gap=loss.link_gap,
                damaged=loss.damaged,
                board_overflow=loss.board_overflow,
                host_overrun=loss.host_overrun,
                queue_overflow=loss.queue_overflow,
                publish_dropped=dropped,
                skipped_late=late + skipped,
            )
        return self._last_lost

    def _publish_link_state(self, link: LinkChange) -> None:
        self._publish(STATE_LINK, self.states.link_state(link, self._outage, self._boots))

    def _publish_sensor_state(
        self, condition: Condition, reason: Reason, since_utc_ns: int, compensation: Compensation | None
    ) -> None:
        state = self.states.sensor_state(condition, reason, since_utc_ns, self._now_utc_ns, compensation)
        self._publish(STATE_SENSOR, state)

    def _publish_info(self) -> None:
        if self.board is not None:
            self._publish(INFO, self.states.info(self.board, self._arrived_utc_ns))
