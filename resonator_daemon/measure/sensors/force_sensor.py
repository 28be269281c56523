"""What sensors of force sites have in common: windows, tare, forces, contacts and their events."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal

import numpy as np

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason
from resonator_daemon.board.config.tables import Measurement
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.compatibility import oscillator_hz
from resonator_daemon.board.session.frames import BoardOnline, Frame
from resonator_daemon.estimate.forces.force_sites import ForceSites, cell_std_m
from resonator_daemon.estimate.forces.readings import Compensation, ContactEvent, ContactTracker, ForceReading
from resonator_daemon.estimate.forces.site_errors import SiteErrors
from resonator_daemon.measure.sensors.base import Sensor
from resonator_daemon.measure.sensors.force_messages import ForceMessages, tones_message
from resonator_daemon.measure.sensors.output import BOARD_RESTARTED, MessageOutput
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS, FORCES, TONES, Topic

if TYPE_CHECKING:
    from resonator_daemon.measure.sensors.surface_decoding import MakeSurfaceDecoding


UNKNOWN_CONTACT_S: Final = 0.5  # for which a contact of which nothing is known is kept


class ForceProcessing(ABC):
    """Records of force sites to readings.

    Parameters
    ----------
    sites
    reference_hz
        Of the board's ticks.
    gate_s
        Length of a gate.
    reach_m
        A touch that moves less between two readings is the same touch.
    """

    def __init__(self, sites: ForceSites, *, reference_hz: float, gate_s: float, reach_m: float = 0.0) -> None:
        self._sites = sites
        self._reference_hz = reference_hz
        self._gate_s = gate_s
        self._errors = SiteErrors(sites)
        self._positions_m: list[tuple[float, float]] = [(x, y) for x, y in sites.positions_m.tolist()]
        self._covariance_m2 = [np.diag(std_m**2) for std_m in cell_std_m(sites.positions_m, sites.outline_m)]
        self._tracker = ContactTracker(round(UNKNOWN_CONTACT_S * reference_hz), reach_m)
        self._last: tuple[int, int] | None = None  # sequence and ticks of the last frame
        self._evaluated_ticks: int | None = None  # of the last reading
        self._response: Literal["on", "off"] = "off" if sites.response is None else "on"

    def end_contacts(self, reason: Reason) -> tuple[ContactEvent, ...]:
        """Release every contact, as when frames have stopped coming; what is still touched then begins again."""
        return self._tracker.close(self._last[1], reason) if self._last else ()

    def restart(self) -> tuple[ContactEvent, ...]:
        """Discard the zero and every contact: the board has booted or is configured again."""
        events = self.end_contacts(BOARD_RESTARTED)
        self._errors.reset()
        self._last = self._evaluated_ticks = None
        self._reset()
        return events

    def set_window(self, window_frames: int, step_frames: int) -> None:
        """Measure over another window from the next reading on; a longer one grows to its length, frame by frame.

        Raises
        ------
        ValueError
            A step of less than one frame, or of more than the window.
        """
        if not 1 <= step_frames <= window_frames:
            raise ValueError(f"step of {step_frames} frames, 1 to the window's {window_frames}")
        self._measure_over(window_frames, step_frames)

    @abstractmethod
    def tare(self) -> str | None:
        """Set the zero to the present readings; return why that cannot be done, None if it was done."""

    @property
    @abstractmethod
    def compensation(self) -> Compensation:
        """What is taken out now."""

    @abstractmethod
    def process(self, frames: Sequence[Frame]) -> list[ForceReading]:
        """Return the readings that end with one of these adjacent frames."""

    @abstractmethod
    def _reset(self) -> None:
        """Discard what the frames up to now have left."""

    @abstractmethod
    def _measure_over(self, window_frames: int, step_frames: int) -> None:
        """Use another window from now on."""


class ForceSensor(Sensor[ForceReading]):
    """Sensor of force sites; a subclass makes what processes its records."""

    result: ClassVar[Topic[Any]] = FORCES
    adjustable: ClassVar[bool] = True
    _processing: ForceProcessing | None = None
    _last: tuple[ForceReading, Instant] | None = None

    @property
    def summary(self) -> str:
        remark = "; hysteresis and creep are not calibrated and count as errors"
        return f"measures the forces on the sites{'' if self.plate.response else remark}"

    @property
    def streams(self) -> tuple[Topic[Any], ...]:
        return FORCES, CONTACTS

    @property
    def window_s(self) -> float:
        return self.measurement.window_s

    @property
    def step_s(self) -> float:
        return self.measurement.step_s

    @property
    def window_frames(self) -> int:
        """Number of frames in a window."""
        return round(self.measurement.window_s * self.plate.counter.frame_rate_hz)

    @property
    def step_frames(self) -> int:
        """Number of frames from reading to reading."""
        return round(self.measurement.step_s * self.plate.counter.frame_rate_hz)

    @abstractmethod
    def make_processing(self, oscillator_hz: Floats) -> ForceProcessing:
        """Return what processes the records of a board that counts each tone against `oscillator_hz` (t,)."""

    def connect(self, output: MessageOutput, make_decoding: "MakeSurfaceDecoding | None") -> None:
        self._output = output
        self._messages = ForceMessages(self.plate, output)

    @property
    def ready(self) -> bool:
        return self._processing is not None

    def begin(self, board: BoardOnline) -> None:
        if self._processing is None:
            self._processing = self.make_processing(oscillator_hz(board.description))
        else:
            self._publish_events_now(self._processing.restart())

    def measure(self, frames: Sequence[Frame]) -> Sequence[ForceReading]:
        return self._processing.process(frames) if self._processing is not None else ()

    def publish(self, reading: ForceReading, gate_middle: Instant) -> None:
        output = self._output
        self._last = (reading, gate_middle)
        if reading.events:
            self._publish_events(reading.events, reading, gate_middle)
        if not reading.at_step:
            return
        compensation = reading.compensation
        output.state.update(reading.status, reading.reason, compensation.common_mode, gate_middle, compensation)
        if output.is_late(gate_middle):
            output.skip(FORCES, CONTACTS, *(() if reading.tones is None else (TONES,)))
            return
        messages = self._messages
        header = messages.header(reading, gate_middle)
        output.publish_result(FORCES, messages.forces(header, reading, gate_middle), gate_middle)
        output.publish(CONTACTS, messages.contacts(header, reading, gate_middle))
        if reading.tones is not None:
            output.publish(TONES, tones_message(self.plate, output.headers.next_seq(TONES), header, reading))

    def end_contacts(self, reason: Reason) -> None:
        if self._processing is not None:
            self._publish_events_now(self._processing.end_contacts(reason))

    def set_window(self, measurement: Measurement) -> None:
        super().set_window(measurement)
        if self._processing is not None:
            self._processing.set_window(self.window_frames, self.step_frames)

    def tare(self) -> str | None:
        return self._processing.tare() if self._processing is not None else "no force sites are being measured"

    @property
    def common_mode(self) -> tuple[float, ...]:
        return tuple(self._processing.compensation.common_mode) if self._processing is not None else ()

    def _publish_events(self, events: Sequence[ContactEvent], reading: ForceReading, gate_middle: Instant) -> None:
        for event in events:
            self._output.publish(CONTACT_EVENT, self._messages.event(event, reading, gate_middle))

    def _publish_events_now(self, events: Sequence[ContactEvent]) -> None:
        """Publish events between readings, under the time of the last one."""
        if self._last is not None:
            self._publish_events(events, *self._last)
