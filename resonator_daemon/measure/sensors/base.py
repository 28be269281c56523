"""Interface of a sensor: what a plate with its counter amounts to; installed packages have the kinds."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.entry_points import load_entry
from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Reason
from resonator_daemon.board.config.tables import Decoding, Measurement
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import BoardOnline, Frame
from resonator_daemon.estimate.forces.readings import ForceReading, SkinReading
from resonator_daemon.estimate.tones.tone_detector import ToneDetector
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones
from resonator_daemon.measure.sensors.output import MessageOutput
from resonator_daemon.mqtt.payloads import SiteCode
from resonator_daemon.mqtt.topics import Topic

if TYPE_CHECKING:
    from resonator_daemon.measure.sensors.surface_decoding import MakeSurfaceDecoding

Reading = TypeVar("Reading", ForceReading, SkinReading)


class Sensor(ABC, Generic[Reading]):
    """Frames of one plate to readings, and readings to messages.

    All that depends on the kind of sensor is an attribute or a method of this class. It reads no clock and never waits.
    `connect` comes first, then `begin` with each board, then frames in their order.

    Parameters
    ----------
    plate
    measurement
        Window and step.
    decoding
        Settings of the decoder.

    Attributes
    ----------
    replaces
        The kind of sensor of resonatord whose plates this kind measures; of those kinds, their own name.
    result
        Topic of the results whose latency counts.
    adjustable
        Whether the zero can be tared and the window be set.
    independent_at_rest
        Whether readings at rest do not depend on what was before; drift of force sites is followed for hours.
    """

    replaces: ClassVar[str]
    result: ClassVar[Topic[Any]]
    adjustable: ClassVar[bool]
    independent_at_rest: ClassVar[bool] = False

    def __init__(self, plate: Plate, measurement: Measurement, decoding: Decoding) -> None:
        self.plate = plate
        self.measurement = measurement
        self.decoding = decoding

    @property
    def problems(self) -> tuple[str, ...]:
        """Why nothing can be measured with this plate and these settings; known without a board."""
        return ()

    @property
    @abstractmethod
    def summary(self) -> str:
        """What an undisturbed sensor reads, and what it does not take out: the reason in its state."""

    @property
    @abstractmethod
    def streams(self) -> tuple[Topic[Any], ...]:
        """Topics that are published continually, decimated topics aside."""

    @property
    def site_codes(self) -> tuple[SiteCode, ...] | None:
        """Codes that identify a site by the captured tones; None if the tones of all sites are counted."""
        return None

    @property
    def pilot_hz(self) -> float | None:
        """Tone that corners capture while nothing is touched; None if there is none."""
        return None

    @property
    def at_rest(self) -> bool:
        """Whether later readings are independent of past frames; False for sensors that keep state."""
        return False

    @property
    @abstractmethod
    def window_s(self) -> float:
        """Length of the window of a reading."""

    @property
    @abstractmethod
    def step_s(self) -> float:
        """Time from reading to reading."""

    @property
    def rate_hz(self) -> float:
        """Readings a second."""
        return 1 / self.step_s

    @property
    def wake_frames(self) -> tuple[int, ...]:
        """Numbers of frames that are worth waking for: every multiple of one of them."""
        return (1,)

    @property
    @abstractmethod
    def expected_tones(self) -> ExpectedTones:
        """Tones of the untouched plate."""

    @abstractmethod
    def tone_detector(self, frames: int, oscillator_hz: Floats) -> ToneDetector:
        """Return a detector of readings over `frames`; the board measures each tone against `oscillator_hz` (t,)."""

    @abstractmethod
    def connect(self, output: MessageOutput, make_decoding: "MakeSurfaceDecoding | None") -> None:
        """Set where messages go, and what decodes, if anything is decoded."""

    @property
    @abstractmethod
    def ready(self) -> bool:
        """Whether a board has begun."""

    @abstractmethod
    def begin(self, board: BoardOnline) -> None:
        """Begin with a board, or again with one whose ticks do not continue those of the past."""

    @abstractmethod
    def measure(self, frames: Sequence[Frame]) -> Sequence[Reading]:
        """Return the readings that end with one of these adjacent frames; `publish` is to follow for each."""

    @abstractmethod
    def publish(self, reading: Reading, gate_middle: Instant) -> None:
        """Publish what follows from a reading whose last gate has this middle."""

    @abstractmethod
    def end_contacts(self, reason: Reason) -> None:
        """Release all contacts, because frames have stopped arriving."""

    def set_window(self, measurement: Measurement) -> None:
        """Measure over other windows from now on."""
        self.measurement = measurement

    @abstractmethod
    def tare(self) -> str | None:
        """Set the zero to the present readings; return why that cannot be done, None if it was done."""

    @property
    def common_mode(self) -> tuple[float, ...]:
        """Relative frequency shift that is taken out of all readings now, by channel; empty if there is none."""
        return ()

    @property
    def records_unusable(self) -> dict[str, int]:
        """Number of records that gave no frequency, by cause."""
        return {}

    @property
    def skipped_late(self) -> int:
        """Number of messages that decoding was too slow for."""
        return 0

    @property
    def suspect_sites(self) -> tuple[int, ...]:
        """Numbers of the sites whose signals contradict those of all others."""
        return ()

    async def run(self) -> None:
        """Decode until cancelled; return at once if nothing is decoded."""


def sensor_of(plate: Plate, measurement: Measurement | None = None, decoding: Decoding | None = None) -> Sensor[Any]:
    """Return the sensor that a plate with its counter amounts to; settings that are not given have their defaults.

    Its module is imported when needed: decoding a skin loads much of scipy, for 0.5 s.

    Raises
    ------
    ConfigurationError
        No installed package has this kind of sensor, or it measures other plates.
    """
    name = plate.counter.sensor or plate.default_sensor
    kind: type[Sensor[Any]] | None = load_entry("sensors", name, _is_sensor)
    if kind is None:
        raise ConfigurationError(f"plate {plate.name!r}: counter.sensor: no package has a usable sensor {name!r}")
    if kind.replaces != plate.default_sensor:
        raise ConfigurationError(
            f"plate {plate.name!r}: counter.sensor: {name!r} measures plates of the kind {kind.replaces!r}, "
            f"but this is one of the kind {plate.default_sensor!r}; take a plate of that kind, or another sensor"
        )
    return kind(plate, measurement or Measurement(), decoding or Decoding())


def _is_sensor(kind: Any) -> bool:
    return issubclass(kind, Sensor)
