"""The messages of the MQTT topics: their fields with meaning, unit and closed sets of words."""

from typing import Annotated, Any, Final

from pydantic import Field, model_validator

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.reasons import Condition, ReasonCode
from resonator_daemon.mqtt.payload_types import (
    Baseline,
    BoardHeader,
    CapturedTone,
    ContactChange,
    ContactShape,
    CounterType,
    Float,
    Float32Array,
    Header,
    Int64,
    Lost,
    Measured,
    Message,
    OptionalFloat,
    PerChannel,
    ResponseCompensation,
    SignalArray,
    Status,
    Vector2,
    Vector3,
    optional,
    optional_number,
)

_SLIP_UNKNOWN = "null with a code in `slip_reason_code`"
_DECODER_ID = "the process that decoded; left out by the daemon itself"
_FOLLOWER_ID = "the decoder process that follows the contacts and assigns their ids; omitted if the daemon does"
_REASON_CODE = "why, for programs; left out where there is nothing to state"
_REASON = "the same as a sentence for people, with details"
_AT_LEAST = "with the status `overload` alone: the force is at least this"
_CPU = "of one core, since the last message"
_MESSAGES = "where each message went"


class SiteForce(Message):
    """Force on one site."""

    site: int = Field(description="number of the site in the plate file")
    force_newton: Float = Field(description="force on the site; null with a cause in `status`")
    noise_newton: Float = Field(description="one standard deviation of what averages out, from the counts themselves")
    systematic_newton: Float = Field(
        description="one standard deviation of what does not average out: calibration, drift, warm touches, the site's "
        "response"
    )
    unobserved_bound_newton: Float = optional_number(
        "the largest force that a touch between sites may exert on other sites, in addition to `force_newton`; not "
        "part of the errors; omitted if it is 0"
    )
    status: Status = Field(description="whether this force is valid")
    at_least_newton: float | None = optional(_AT_LEAST)


class Compensation(Message):
    """What was taken out of the frequencies before they became forces."""

    baseline: Baseline = Field(description="how the frequencies of the untouched plate are known")
    common_mode: PerChannel = Field(
        description="relative error of the frequencies of each channel: the board's reference, and the plate's "
        "temperature as the pilot shows it"
    )
    common_mode_std: Float = Field(
        description="what it may be off by; null on channelised counters, where each site has its own"
    )
    plate_kelvin: Float = Field(
        description="temperature of the plate above `thermal.reference_kelvin`; null on single-tone counters. Changes "
        "are known far better than the value"
    )
    plate_kelvin_std: Float = Field(description="its standard deviation; near 20 K where only changes are known")
    response: ResponseCompensation = Field(description="whether hysteresis and creep of the sites are taken out")


class Forces(Measured):
    """Forces on the touched sites in one window."""

    window_s: float = Field(description="length of the window that was counted; shorter just after an onset")
    status: Status = Field(description="of the whole message: why sites may be missing")
    reason_code: ReasonCode | None = optional(_REASON_CODE + "; `ok` may have one, too, as channels without a signal")
    reason: str | None = optional(_REASON)
    sites: tuple[SiteForce, ...] = Field(description="those on which something presses")
    beats: tuple[int, ...] | None = optional(
        "channels whose tone beats with the board's reference clock; `noise_newton` includes the effect"
    )


class CornerTone(Message):
    """Tone that one corner has captured."""

    captured: CapturedTone = Field(description="what tone it is")
    site: int | None = Field(description="the site whose tone it is; null unless `captured` is `site`")
    frequency_hz: Float = Field(
        description="the tone, common mode taken out: to be compared with `codes` and `pilot_hz` of `info`; null with "
        "the cause in `reason_code`"
    )
    noise_hz: Float = Field(description="one standard deviation of what averages out, from the counts themselves")
    residual: Float = Field(
        description="of the identified site: the tone's relative shift less that of the fitted force, in standard "
        "deviations of all its errors; null where no force is fitted"
    )
    reason_code: ReasonCode | None = optional("why the tone is null, for programs")


class Tones(Measured):
    """Tones of the corners in one window, and the site that each is assigned to."""

    window_s: float = Field(description="length of the window that was counted")
    status: Status = Field(description="of the identification, as in `forces`")
    reason_code: ReasonCode | None = optional(_REASON_CODE + "; the sentence is in `forces`")
    corners: Annotated[tuple[CornerTone, ...], Field(min_length=CHANNEL_COUNT, max_length=CHANNEL_COUNT)] = Field(
        description="in the order of the channels"
    )


class FitQuality(Message):
    """How well the model of a contact explains the signals of one frame; contacts fitted together share it."""

    chi2: float = Field(description="per degree of freedom: about 1 if the model holds, at every noise")
    degrees_of_freedom: int = Field(description="signals less parameters of the contacts")
    p: float = Field(description="chance of a `chi2` this large or larger if the model holds")


class Contact(Message):
    """One touch, from its onset to its release under one id; components x, y, z.

    Moments, slip and fit are keys of skins alone.
    """

    id: int = Field(description="the same from onset to release")
    site: int = Field(description="the nearest site")
    position_m: Vector2 = Field(description="x and y of the centre of pressure; on a single-tone counter, of the site")
    position_covariance_m2: Vector3 = Field(
        description="covariance of the errors of x and y: xx, xy, yy. On a single-tone counter, it is that of all "
        "positions nearest to the site. xy is null under a skin"
    )
    force_newton: Vector3 = Field(
        description="x, y, z; x and y are null if the plate measures only the normal force; all are null if the force "
        "is unknown, with the cause in `status`"
    )
    noise_newton: Vector3 = Field(description="one standard deviation of what averages out, from the counts themselves")
    systematic_newton: Vector3 | None = optional(
        "one standard deviation of what does not average out: of a force site, calibration, drift, warm touches and "
        "the site's response (x and y null); under a skin, what the plate file states of depth, modulus, gains and "
        "places of the sites; null where the contact was not fitted"
    )
    position_systematic_m: Vector2 | None = optional("likewise, of x and y under a skin")
    at_least_newton: float | None = optional(_AT_LEAST)
    moment_newton_m: Vector3 | None = optional("about the origin of the plate's coordinates")
    moment_std_newton_m: Vector3 | None = optional("standard deviation of each")
    slip_margin: OptionalFloat = optional(f"1 - F_t / (mu F_n): 1 without shear, 0 where it slips; {_SLIP_UNKNOWN}")
    slip_margin_std: OptionalFloat = optional("its standard deviation")
    friction_coefficient: OptionalFloat = optional(
        "mu, if known to 25 %, from this frame and earlier ones; a configured one counts as known to 3 %; null with a "
        "code in `slip_reason_code`"
    )
    friction_coefficient_std: OptionalFloat = optional("its standard deviation")
    slip_margin_systematic: OptionalFloat = optional("of the slip margin, as `systematic_newton`")
    friction_coefficient_systematic: OptionalFloat = optional("of the friction coefficient, as `systematic_newton`")
    fit: FitQuality | None = optional("under a skin; left out where the contact was not fitted")
    shape: ContactShape | None = optional("under a skin: what object the signals fit, if known")
    slip_reason_code: ReasonCode | None = optional("why the slip margin or the friction coefficient is null")
    status: Status = Field(description="whether this contact's numbers are valid")
    reason_code: ReasonCode | None = optional(_REASON_CODE)


class EventContact(Contact):
    """A contact in an event, with its history."""

    id: int = Field(description="the same from onset to release, and not used again in the same run")
    peak_newton: Float = Field(description="the greatest normal force of the contact so far")
    peak_at_least_newton: Float | None = optional(
        "of a contact that was overloaded: the greatest force was at least this"
    )
    since_t_ns: Int64 = Field(description="its onset, UTC")
    duration_s: Float = Field(description="from the onset to the last reading that gave its force")


class Contacts(Measured):
    """All present contacts."""

    status: Status = Field(description="of the whole message")
    reason_code: ReasonCode | None = optional(_REASON_CODE + "; the sentence is in `forces` or `decoded/summary`")
    contacts: tuple[Contact, ...] = Field(description="all present contacts")
    decoder_id: str | None = optional(_FOLLOWER_ID)


class ContactEvent(Measured):
    """A contact begins, ends or slips."""

    event: ContactChange = Field(description="what happens")
    reason_code: ReasonCode | None = optional("why a contact is released, for programs; each release has one")
    reason: str | None = optional(_REASON)
    contact: EventContact = Field(
        description="its last state: the force of one that is no longer detected may be null already"
    )
    decoder_id: str | None = optional(_FOLLOWER_ID)
    replayed: bool = Field(
        False,
        description="it waited for a broker, or may have come before",
    )


def _of_one_shape(first: str, *others: str) -> Any:
    """Return a validator that refuses arrays of another shape than that of the first key."""

    def check(message: Message) -> Message:
        shape = getattr(message, first).shape
        for name in others:
            array = getattr(message, name)
            if array is not None and array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, must be that of {first}, {shape}")
        return message

    return model_validator(mode="after")(check)


class Signals(Measured):
    """What the sites of a skin sense."""

    signals: SignalArray = Field(
        description="float32 [3, n] in the order of the sites, rows 3 p_n / (2 E), eps_xz, eps_yz; NaN where not known"
    )
    noise_std: SignalArray = Field(description="standard deviation of each, same shape; NaN where not known")
    status: Status = Field(description="of the frame; `ok` alone is fit for decoding")

    _shapes = _of_one_shape("signals", "noise_std")


class Grid(Message):
    """Where the pixels of an array [..., ny, nx] lie."""

    origin_m: tuple[float, float] = Field(description="x, y of pixel [0, 0]")
    pitch_m: float = Field(description="from pixel to pixel")


class Decoded(Measured):
    """What happens on the skin's surface; components x, y, z in this order."""

    traction_pascal: Float32Array = Field(
        description="float32 [3, ny, nx], or [3, m] at scattered points; what the object exerts on the skin"
    )
    traction_std_pascal: Float32Array | None = Field(
        description="standard deviation of that map, same shape; null where the decoder was not asked for it"
    )
    displacement_m: Float32Array | None = Field(
        description="of the surface, same shape; null where the decoder was not asked for it"
    )
    grid: Grid | None = Field(description="places of the values; null at scattered points, the sites")
    decoder_id: str | None = optional(_DECODER_ID)

    _shapes = _of_one_shape("traction_pascal", "traction_std_pascal", "displacement_m")


class Patch(Message):
    """What the map shows of one contact beyond its message in `contacts`.

    What only a fit of the contact yields is null where the fit does not hold, or the contact slips too little to show.
    """

    id: int | None = Field(
        description="as in `contacts`, whose order is the same; null if decoders of a group share the skin"
    )
    area_m2: Float = Field(description="of contact, from a fit to the signals; else of the pressed part of the map")
    area_std_m2: Float = Field(description="its standard deviation; null without a fit")
    at_border: bool = Field(description="part of the contact may lie beyond the sites")
    long_half_axis_m: Vector2 | None = optional("long half-axis of an `ellipse`, as x and y of its end")
    long_half_axis_std_m: Vector2 | None = optional("its standard deviations")
    short_half_axis_m: float | None = optional("short half-axis of an `ellipse`, radius of a `punch`")
    short_half_axis_std_m: float | None = optional("its standard deviation")
    radius_of_curvature_m: Float = Field(description="of the object, taken as a paraboloid")
    radius_of_curvature_std_m: Float = Field(description="its standard deviation")
    stick_ratio: Float = Field(
        description="radius of the part that sticks over the radius of contact, from a fit to the signals"
    )
    stick_ratio_std: Float = Field(description="its standard deviation")


class DecodedSummary(Measured):
    """What the map shows, in few numbers, and how well the decoder's model explains the frame."""

    decoder: str = Field(
        description="what made the map: `open-plane` or `fourier`, with `+contact` where contact physics is on"
    )
    border_contact: bool = Field(description="the load reaches the border, where errors are larger")
    status: Status = Field(
        description="of the frame; `constraint_dropped`: the signals contradict contact physics, and `reason` states "
        "what is shown instead"
    )
    reason_code: ReasonCode | None = optional(
        _REASON_CODE
        + "; `ok` may have one, too: lost signals, matrices that are being prepared, a fit instead of a map"
    )
    reason: str | None = optional(_REASON)
    patches: tuple[Patch, ...] = Field(description="the contacts, in the order of `contacts`")
    decoder_id: str | None = optional(_DECODER_ID)


class OutageInfo(Message):
    """A time without frames that is over."""

    start_t_ns: Int64 = Field(description="UTC, middle of the last gate before, by the clock as it is at the end")
    end_t_ns: Int64 = Field(description="UTC, middle of the first gate after")
    frames_lost: int = Field(description="frames that the board sent meanwhile, or would have")
    reason_code: ReasonCode = Field(
        ReasonCode.UNSPECIFIED, description="reason of the link's state when it began, for programs"
    )
    reason: str = Field(description="the same as a sentence for people")


class State(BoardHeader):
    """State of the daemon, its link or its sensor."""

    state: Condition = Field(description="one word")
    reason_code: ReasonCode = Field(ReasonCode.UNSPECIFIED, description="why, for programs")
    reason: str = Field(description="the same as a sentence for people, with details")
    since_t_ns: Int64 | None = Field(description="UTC, start of the state; null in the last will")
    last_outage: OutageInfo | None = optional(
        "of `state/link`: the last time without frames that is over, since the daemon started"
    )
    boot_count: int | None = optional("of `state/link`: different boots of the board seen since the daemon started")
    connections: int | None = optional("of `state/daemon`: connections to the broker since the daemon started")
    connected_t_ns: Int64 | None = optional("of `state/daemon`: UTC, since when the present connection lasts")
    compensation: Compensation | None = optional(
        "of `state/sensor` of force sites: what was taken out before frequencies became forces; sent again each second"
    )
    suspect_sites: tuple[int, ...] | None = optional("of `state/sensor`, with `sensor_suspect`: numbers of these sites")


class SiteInfo(Message):
    """Where a site is."""

    site: int = Field(description="number of the site in the plate file")
    position_m: tuple[float, float] = Field(description="x, y in the plate's plane")


class SiteCode(Message):
    """Frequency code of a site, by channel."""

    site: int = Field(description="number of the site in the plate file")
    f0_hz: PerChannel = Field(description="its tone on each channel while nothing presses")
    full_load_hz: PerChannel = Field(description="the same under `force_max_newton`")


class GridInfo(Grid):
    """A grid of sites, in the order of the sites: row by row, x running first."""

    shape: tuple[int, int] = Field(description="ny, nx")


class CalibrationInfo(Message):
    """Where the plate's numbers come from; what the plate file does not give is null."""

    id: str | None = Field(description="of the calibration")
    date: str | None = Field(description="YYYY-MM-DD")
    unit: str | None = Field(description="serial number of the plate that was calibrated")
    expiry: str | None = Field(description="YYYY-MM-DD; later the sensor's state is `uncalibrated`")
    model_error: float = Field(description="relative standard deviation of K from touch to touch and corner")
    sensitivity_std: float = Field(description="relative, one standard deviation: what all K share")
    response: ResponseCompensation = Field(description="whether hysteresis and creep are taken out")


class SkinInfo(Message):
    """What a decoder needs of a skin apart from its sites: an elastic half-space over sensors at one depth."""

    youngs_modulus_pascal: float = Field(description="of the skin")
    poisson_ratio: float = Field(description="of the skin")
    depth_m: float = Field(description="of the sites below the surface")
    gain_std: float = Field(description="relative, one standard deviation: of a channel's sensitivity")
    depth_std_m: float = Field(0.0, description="standard deviation of the depth")
    modulus_std_pascal: float = Field(0.0, description="standard deviation of Young's modulus")
    gain_std_common: float = Field(0.0, description="relative, one standard deviation: of all sensitivities together")
    position_std_m: float = Field(0.0, description="standard deviation of the place of each site, in x and in y")
    correlation_length_m: float = Field(description="of loads that are expected")
    tangential_ratio: float = Field(description="of the shear of expected loads to their pressure")


class Info(BoardHeader):
    """What does not change while the board and the configuration stay the same; enough to draw the plate."""

    schema_version: str = Field(description="of all payloads, major.minor")
    daemon_version: str = Field(description="of resonatord")
    plate: str = Field(description="name of the plate")
    link: str = Field(description="to the board, as in the configuration")
    product: str = Field(description="of the board, as it reports it")
    serial_number: str | None = Field(description="of the board; null where it has none")
    firmware: str = Field(description="version of the board's firmware")
    counter: CounterType = Field(description="kind of the board's counter")
    frame_rate_hz: float = Field(description="frames of the board")
    window_s: float = Field(description="length of a window of `forces`; of a skin each frame is one")
    step_s: float = Field(description="from window to window")
    rates_hz: dict[str, float] = Field(description="by topic: messages a second, at most")
    units: dict[str, str] = Field(description="unit by the longest ending of a key after an underscore, without `_std`")
    commands: tuple[str, ...] = Field(description="verbs that this daemon executes")
    force_max_newton: float = Field(description="end of the plate's range")
    outline_m: tuple[tuple[float, float], ...] = Field(description="corners of the plate, x, y")
    transducers_m: tuple[tuple[float, float], ...] = Field(description="x, y, in the order of the channels")
    sites: tuple[SiteInfo, ...] = Field(description="in the order of the arrays of `signals`")
    grid: GridInfo | None = Field(description="of the sites; null where they are scattered")
    skin: SkinInfo | None = Field(description="null on a plate of force sites")
    calibration: CalibrationInfo = Field(description="where the plate's numbers come from")
    codes: tuple[SiteCode, ...] | None = optional(
        "of a single-tone counter: what the tones of the corners are compared with, in the order of the sites"
    )
    pilot_hz: float | None = optional("of a single-tone counter: the tone of the untouched plate")


class MessageAccount(Message):
    """Where the publisher's messages went.

    At any instant enqueued = acknowledged + written + sum of dropped + unknown_at_disconnect + waiting.
    """

    enqueued: int = Field(0, description="all, including the next three")
    republished: int = Field(0, description="retained messages sent again after a reconnection")
    resent: int = Field(0, description="events sent again, because a connection ended before their acknowledgement")
    recovered: int = Field(0, description="events that an earlier run of the daemon had left in the spool")
    acknowledged: int = Field(0, description="QoS 1: acknowledged by the broker")
    written: int = Field(0, description="QoS 0: written to the connection in full")
    dropped: dict[str, int] = Field({}, description="never sent, by cause")
    unknown_at_disconnect: int = Field(0, description="on their way when the connection ended")
    waiting: int = Field(0, description="queued, on disk, or on their way")
    spooled: int = Field(0, description="of those waiting: on disk")


class BootInfo(Message):
    """What one boot of the board sent; a gap counts for the boot whose frame ended it."""

    board_boot_id: str = Field(description="which boot")
    connections: int = Field(description="openings of the link during this boot")
    frames: int = Field(description="frames that arrived")
    lost: dict[str, int] = Field(description="frames by cause, as in the header")
    lost_in_outages: dict[str, int] = Field(description="of these: in outages that `state/link` has reported")


class LatencyInfo(Message):
    """Histogram of the time from the end of a window's last gate to the hand-over of its message to the publisher."""

    bounds_ms: tuple[float, ...] = Field(description="upper bounds of all bins but the last, which has none")
    counts: tuple[int, ...] = Field(description="messages in each bin since the daemon, or decoder, started")


class DecoderProcessInfo(Message):
    """Counters and load of the process that decodes a skin.

    Frames that were measured without a fault since the daemon started = `decoded` + sum of `skipped` + `waiting`.
    """

    pid: int | None = Field(description="process id; null while it is being started")
    restarts: dict[str, int] = Field(
        description="since the daemon started, by what ended the process before: `crashed`, `hung`"
    )
    decoded: int = Field(description="frames that were decoded")
    skipped: dict[str, int] = Field(
        description="frames that were not, by cause: `newer_frame`, `too_old` (above 0.1 s), `measured_late`, "
        "`no_noise` (not known yet), `not_ready` (set-up), `decoder_ended`, `undecodable`"
    )
    waiting: int = Field(description="frames that are being decoded, or are next")
    cpu_percent: Float = Field(description=_CPU)
    rss_mb: Float = Field(description="memory of the process")


class RecordingInfo(Message):
    """What is being recorded of the link, and what all recordings since the daemon started have come to."""

    file: str | None = Field(description="the present one, on the daemon's computer, or null")
    since_t_ns: Int64 | None = Field(description="UTC, start of the recording, or null")
    failure_code: ReasonCode | None = optional("why nothing is written to it, for programs; left out while all is well")
    failure: str | None = Field(description="the same as a sentence, else null")
    file_bytes: int = Field(description="written bytes of the present file")
    files: int = Field(description="files that were begun since the daemon started")
    files_removed: int = Field(description="old recordings that went because of `max_total_mb`, since then")
    events_missing: int = Field(
        description="pieces of the link's traffic that are in no file although it was recorded since then: the disk "
        "was too slow or failed"
    )
    messages: int = Field(description="published messages that are in files, since then")
    messages_missing: int = Field(description="those that are not, because the disk was too slow or failed")


class Health(BoardHeader):
    """Counters and load of the daemon."""

    reason_code: ReasonCode | None = Field(
        None, description="`computer_busy` while the computer is too busy for the daemon, else null"
    )
    uptime_s: float = Field(description="since the daemon started")
    frames: int = Field(description="frames that arrived since then")
    frame_rate_hz: Float = Field(description="since the last `health`")
    parts_lost: int = Field(description="parts of large frames that were damaged or missing; their tones are not known")
    frames_not_decoded: int = Field(
        description="skipped by the decoder; `decoder` has them by cause, and those that came before it was ready"
    )
    sites_suspect: int = Field(0, description="sites whose signals contradict those of all others")
    records_unusable: dict[str, int] = Field(description="readings that gave no frequency, by cause")
    packets_ignored: dict[str, int] = Field(
        description="undamaged packets without use, by cause: from before a reset, malformed, of unknown type, lines "
        "of the board's log beyond 20 a second"
    )
    bytes_in: int = Field(description="bytes from the board")
    bytes_by_outcome: dict[str, int] = Field(description="what became of them; their sum is `bytes_in`")
    connections: int = Field(description="openings of the link")
    host_overruns: int = Field(description="reports of lost bytes by the host's driver")
    boots: tuple[BootInfo, ...] = Field(description="of the board, the latest eight, the present one last")
    clock_drift_ppm: Float = Field(
        description="rate of the board's clock against this computer's, null until it is known to 10 ppm"
    )
    clock_outliers: int = Field(description="pings whose answer contradicted the others")
    clock_restarts: int = Field(description="times that the board's clock had to be estimated again")
    cpu_percent: Float = Field(description=_CPU + "; without the decoder's")
    processor_wait_percent: Float = Field(
        0.0,
        description="wait for a processor, as a share of the time in which the daemon could run; mean over 2 s",
    )
    rss_mb: Float = Field(description="memory of the daemon, without the decoder's")
    tasks: int = Field(description="of the daemon's event loop")
    threads: int = Field(description="of the daemon")
    file_descriptors: int = Field(description="that the daemon holds open")
    latency: dict[str, LatencyInfo] = Field(description="by topic")
    decoder: DecoderProcessInfo | None = Field(None, description="the process that decodes a skin, or null")
    recording: RecordingInfo = Field(description="what is recorded, and was since the daemon started")
    commands: dict[str, int] = Field(
        default_factory=dict,
        description="commands by outcome: `done`, an error's code, `unanswered`",
    )
    messages: MessageAccount = Field(description=_MESSAGES)


class DecoderState(Message):
    """State of a decoder process, which may decode several plates."""

    decoder_id: str = Field(description="that of the topic, and of the messages it publishes")
    state: Condition = Field(description="one word")
    reason_code: ReasonCode = Field(ReasonCode.UNSPECIFIED, description="why, for programs")
    reason: str = Field(description="the same as a sentence for people, with details")
    t_ns: Int64 = Field(description="UTC, when it was published")
    since_t_ns: Int64 | None = Field(description="UTC, start of the state; null in the last will")
    topic_filter: str = Field(description="the signals it takes")


class DecoderPlateHealth(Message):
    """What a decoder did with the signals of one plate; received = decoded + skipped + unusable + waiting."""

    received: int = Field(description="messages of `signals` since the decoder started")
    decoded: int = Field(description="published as `decoded` and `decoded/summary`")
    skipped: int = Field(description="a newer frame existed, or the decoder was not ready")
    unusable: int = Field(description="not a message, another shape than in `info`, or the noise is not known yet")
    waiting: int = Field(description="being decoded, or next")
    missed: int = Field(description="gaps in `seq`; in a group also frames that others received")


class DecoderHealth(Message):
    """Counters and load of a decoder process, once a second."""

    decoder_id: str = Field(description="that of the topic")
    t_ns: Int64 = Field(description="UTC, when it was made")
    uptime_s: float = Field(description="since the decoder started")
    plates: dict[str, DecoderPlateHealth] = Field(description="by plate")
    cpu_percent: Float = Field(description=_CPU + ", with its child process")
    rss_mb: Float = Field(description="memory of the decoder, with its child process")
    latency: dict[str, LatencyInfo] = Field(
        description="of `decoded`, of all plates, from the window to the hand-over, by UTC: clocks of two "
        "computers must agree"
    )
    messages: MessageAccount = Field(description=_MESSAGES)


WITH_ARRAYS: Final = (Signals, Decoded)  # these are CBOR, all others JSON
