"""The messages of the MQTT topics: fields, units and the closed sets of words, as pydantic models.

Floats that are not known are NaN here and null in JSON. 64-bit integers are decimal strings in JSON, because many
readers of JSON hold numbers as doubles, exact only to 2^53.
"""

import math
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, PlainValidator, model_validator

Int64 = Annotated[int, Field(ge=0, lt=2**64), PlainSerializer(str, when_used="json")]
Float = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
Vector2 = tuple[Float, Float]
Vector3 = tuple[Float, Float, Float]


def _float32(value: Any) -> NDArray[np.float32]:
    if not isinstance(value, np.ndarray) or value.ndim not in (2, 3) or value.shape[0] != 3:
        raise ValueError(f"{np.shape(value)}: must be an array of shape (3, n) or (3, ny, nx)")
    return np.asarray(value, "<f4")


Float32Array = Annotated[NDArray[np.float32], PlainValidator(_float32)]


class Status(StrEnum):
    """What a number is worth; where it is not "ok" and no number is given, this is the reason."""

    OK = "ok"
    SETTLING = "settling"  # the window is not full yet, as after the start and when the captured tone has changed
    CONSTRAINT_DROPPED = "constraint_dropped"  # contact physics given up for this frame, the linear map is shown
    AMBIGUOUS = "ambiguous"  # two sites explain the readings about equally well
    REJECTED = "rejected"  # no load explains the readings
    POSSIBLY_MORE = "possibly_more"  # a second touch cannot be excluded
    OVERLOAD = "overload"  # beyond the plate's range: the force is null, at_least_newton is given
    NO_SIGNAL = "no_signal"  # nothing, or too little, is heard
    PILOT_LOST = "pilot_lost"  # the untouched reference tone is not heard
    UNCALIBRATED = "uncalibrated"  # beyond what the calibration covers, or later: force and errors are guesses
    PRESSED_AT_START = "pressed_at_start"  # touched before the untouched plate was known: no force can be given


class Condition(StrEnum):
    """The words of the three states, daemon, link and sensor."""

    OFFLINE = "offline"  # not running: stopped, or gone without a word (last will)
    STARTING = "starting"  # on the way to online; nothing is wrong yet
    ONLINE = "online"  # working
    WAITING = "waiting"  # what it needs (port, board, network, frames) is not there; tried again for ever
    STALLED = "stalled"  # the link is open and nothing usable comes
    LOST = "lost"  # was there and went away; tried again for ever
    DRIFTING = "drifting"  # the baseline moves faster than touches and temperature explain
    PRESSED_AT_START = "pressed_at_start"  # touched before the untouched plate was known; release it
    UNCALIBRATED = "uncalibrated"  # the calibration has expired
    REFUSED = "refused"  # the board or the plate file can never serve this configuration


class Message(BaseModel):
    """Base of every payload and its parts; keys that a reader does not know are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True)


class Lost(Message):
    """Losses since the daemon started, by cause: frames, and for publish_dropped messages."""

    link_gap: int = 0
    damaged: int = 0
    board_overflow: int = 0
    host_overrun: int = 0
    ring_overflow: int = 0
    publish_dropped: int = 0


class Header(Message):
    """Carried by every message; seq counts the messages made for its topic since the daemon started."""

    seq: int
    daemon_boot_id: str
    board_boot_id: str | None
    t_ns: Int64  # UTC; of measured messages the middle of the window, of others when they were made
    t_unc_ns: int  # bound of the error of t_ns
    lost: Lost


class Measured(Header):
    """Header of what was measured: with the board's clock at the end of the window's last gate, where known."""

    board_ticks: Int64 | None


class SiteForce(Message):
    """Force on one site."""

    site: int
    force_newton: Float
    noise_newton: Float
    systematic_newton: Float
    hidden_newton: Float = 0.0  # the most that a touch between sites may have put on others, where a cover shares it
    status: Status
    at_least_newton: float | None = None  # a lower bound, with "overload"


class Compensation(Message):
    """What was taken out of the frequencies before they became forces."""

    baseline: Literal["followed", "held", "unknown"]  # held: during a touch, when nothing tells how it drifts
    common_mode: tuple[Float, ...]  # relative frequency error by channel
    common_mode_std: Float  # what it may be off by
    plate_kelvin: Float  # temperature against the calibration's, null where no tone tells it
    plate_kelvin_std: Float
    response: Literal["on", "off"]  # hysteresis and creep of the sites; off: not calibrated


class Forces(Measured):
    """Forces on the touched sites in one window."""

    window_s: float
    status: Status
    reason: str  # empty where there is nothing to say
    sites: tuple[SiteForce, ...]
    beats: tuple[int, ...]  # channels whose tone beats with the counter's reference; noise_newton has it
    compensation: Compensation


class Contact(Message):
    """One touch, from its onset to its release under one id."""

    id: int
    site: int
    position_m: Vector2
    position_std_m: Vector2
    position_correlation: Float  # of x and y
    force_newton: Float
    noise_newton: Float
    systematic_newton: Float
    hidden_newton: Float = 0.0
    peak_newton: Float
    since_t_ns: Int64
    duration_s: Float
    status: Status
    reason: str = ""
    at_least_newton: float | None = None


class EventContact(Contact):
    """A contact as an event tells of it; what belongs to slip is null on plates without a skin, or not known."""

    slip_margin: Float = math.nan
    slip_margin_std: Float = math.nan
    friction_coefficient: Float = math.nan


class Contacts(Measured):
    """All present contacts."""

    status: Status
    reason: str = ""
    contacts: tuple[Contact, ...]


class ContactEvent(Measured):
    """A contact begins, ends or slips."""

    event: Literal["onset", "release", "incipient_slip", "gross_slip"]
    reason: str = ""  # of a release
    contact: EventContact


class Signals(Measured):
    """What the sites sense, in the order of the sites: [3 p_n / (2 E), eps_xz, eps_yz]."""

    signals: Float32Array
    noise_std: Vector3  # standard deviation of each of the three, the median over the sites


class Grid(Message):
    """Where the pixels of an array [..., ny, nx] lie."""

    origin_m: tuple[float, float]  # of pixel [0, 0]: x, y
    pitch_m: float


class Decoded(Measured):
    """What happens on the skin's surface; components x, y, z."""

    traction_pascal: Float32Array
    traction_std_pascal: Float32Array
    displacement_m: Float32Array | None
    grid: Grid | None  # None: values at scattered points

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        shape = self.traction_pascal.shape
        for name in ("traction_std_pascal", "displacement_m"):
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, must be that of traction_pascal, {shape}")
        return self


class Patch(Message):
    """One contact on a skin; components x, y, z, moments about the origin of the plate's coordinates.

    What only a fit of the contact tells is null where the fit does not hold, or the contact slips too little to show.
    """

    id: int
    centroid_m: Vector2
    centroid_std_m: Vector2
    area_m2: Float
    force_newton: Vector3
    force_std_newton: Vector3
    moment_newton_m: Vector3
    moment_std_newton_m: Vector3
    at_border: bool  # part of it may lie beyond the sites
    radius_of_curvature_m: Float  # of a paraboloid
    stick_ratio: Float  # radius that sticks over radius of contact
    slip_margin: Float  # 1 - F_t / (mu F_n)
    slip_margin_std: Float
    friction_coefficient: Float  # as signals and what was told or learnt before have it
    friction_coefficient_std: Float
    slip_reason: str  # why those before are not known; empty where they are


class DecodedSummary(Measured):
    """What the map shows, in few numbers, and how well the decoder's model explains the frame."""

    decoder: str
    chi2: Float
    border_contact: bool
    status: Status
    reason: str  # empty where there is nothing to say
    patches: tuple[Patch, ...]


class OutageInfo(Message):
    """A time without frames that is over."""

    start_t_ns: Int64  # UTC, middle of the last gate before
    end_t_ns: Int64  # and of the first after
    frames_lost: int
    reason: str  # what was said of the link when it began


class State(Header):
    """State of the daemon, its link or its sensor."""

    state: Condition
    reason: str
    since_t_ns: Int64 | None  # None in the last will: nobody is left to date it
    last_outage: OutageInfo | None = None  # of the link, since the daemon started


class SiteInfo(Message):
    """Where a site is."""

    site: int
    position_m: tuple[float, float]


class CalibrationInfo(Message):
    """Where the plate's numbers come from; dates as YYYY-MM-DD."""

    id: str | None
    date: str | None
    unit: str | None
    expiry: str | None
    model_error: float  # relative, of K from touch to touch and corner
    sensitivity_std: float  # relative, of all K
    response: Literal["on", "off"]  # hysteresis and creep are taken out, or not calibrated


class Info(Header):
    """What does not change while the board stays the same."""

    daemon_version: str
    plate: str
    link: str
    serial_number: str | None
    frame_rate_hz: float
    window_s: float
    step_s: float
    force_max_newton: float
    outline_m: tuple[tuple[float, float], ...]
    sites: tuple[SiteInfo, ...]
    calibration: CalibrationInfo


class MessageAccount(Message):
    """Where the publisher's messages went.

    At any instant made = acknowledged + handed_to_socket + dropped + unknown_at_disconnect + waiting.
    """

    made: int  # everything below, retained messages sent again after a reconnection included
    restored: int  # of those made: retained messages sent again
    acknowledged: int  # QoS 1: the broker said so
    handed_to_socket: int  # QoS 0: written to the connection in full
    dropped: int  # never handed over: no connection, queue full, replaced by a newer state, refused by the broker
    unknown_at_disconnect: int  # on their way when the connection ended
    waiting: int  # queued, or on their way


class BootInfo(Message):
    """What one boot of the board sent; a gap counts for the boot whose frame ended it."""

    board_boot_id: str
    connections: int
    frames: int
    lost: dict[str, int]  # frames by cause


class Health(Header):
    """How the daemon itself fares."""

    uptime_s: float
    frames: int
    frame_rate_hz: Float
    parts_lost: int  # of channelised frames that did arrive; their tones are NaN
    frames_not_decoded: int  # skipped because a newer one was there
    records_unusable: dict[str, int]  # readings that gave no frequency, by cause
    packets_ignored: dict[str, int]  # sound packets that led to nothing: stale, malformed, unknown
    bytes_in: int
    bytes_by_fate: dict[str, int]  # their sum is bytes_in
    connections: int  # openings of the link
    host_overruns: int  # times that the host's driver said it had lost bytes of the link
    boots: tuple[BootInfo, ...]  # of the board: the latest, the present one last
    clock_drift_ppm: Float
    clock_outliers: int  # pings that contradicted the others
    clock_restarts: int  # times that the board's clock had to be learnt anew
    cpu_percent: Float
    rss_mb: Float
    messages: MessageAccount
