"""Messages about the parts that measure: states, what a plate is, and how daemon and decoders fare."""

from pydantic import Field

from resonator_daemon.base.reasons import Condition, ReasonCode
from resonator_daemon.mqtt.measured_payloads import Compensation, Grid
from resonator_daemon.mqtt.payload_types import (
    BoardHeader,
    CounterType,
    Float,
    Int64,
    Message,
    PerChannel,
    ResponseCompensation,
    optional,
)

_CPU = "of one core, since the last message"
_MESSAGES = "where each message went"


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
    since_t_ns: Int64 | None = Field(
        description="UTC, since when the state lasts; null in the last will: nobody is left to date it"
    )
    last_outage: OutageInfo | None = optional(
        "of `state/link`: the last time without frames that is over, since the daemon started"
    )
    boot_count: int | None = optional("of `state/link`: different boots of the board seen since the daemon started")
    connections: int | None = optional("of `state/daemon`: connections to the broker since the daemon started")
    connected_t_ns: Int64 | None = optional("of `state/daemon`: UTC, since when the present connection lasts")
    compensation: Compensation | None = optional(
        "of `state/sensor` of force sites: what was taken out before frequencies became forces; sent again each second"
    )


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
    model_error: float = Field(
        description="relative, one standard deviation: scatter of K from touch to touch and corner"
    )
    sensitivity_std: float = Field(description="relative, one standard deviation: what all K share")
    response: ResponseCompensation = Field(description="whether hysteresis and creep are taken out")


class SkinInfo(Message):
    """What a decoder needs of a skin apart from its sites: an elastic half-space over sensors at one depth."""

    youngs_modulus_pascal: float = Field(description="of the skin")
    poisson_ratio: float = Field(description="of the skin")
    depth_m: float = Field(description="of the sites below the surface")
    gain_std: float = Field(description="relative, one standard deviation: of a channel's sensitivity")
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

    enqueued: int = Field(0, description="all of them, those of the next three lines included")
    republished: int = Field(0, description="retained messages sent again after a reconnection")
    resent: int = Field(
        0, description="events whose acknowledgement was outstanding when a connection ended, sent again"
    )
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
    """How the process that decodes a skin fares.

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

    file: str | None = Field(description="the present one, on the daemon's machine; null while nothing is recorded")
    since_t_ns: Int64 | None = Field(description="UTC, when the recording began; null while nothing is recorded")
    failure_code: ReasonCode | None = optional("why nothing is written to it, for programs; left out while all is well")
    failure: str | None = Field(description="the same as a sentence; null while all is well")
    file_bytes: int = Field(description="what is written of the present file, 0 while nothing is recorded")
    files: int = Field(description="files that were begun since the daemon started")
    files_removed: int = Field(description="old recordings that went because of `max_total_mb`, since then")
    events_missing: int = Field(
        description="pieces of the link's traffic that are in no file although it was recorded since then: the disk "
        "was too slow or failed"
    )
    messages: int = Field(description="published messages that are in files, since then")
    messages_missing: int = Field(description="those that are not, because the disk was too slow or failed")


class Health(BoardHeader):
    """How the daemon itself fares."""

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
    records_unusable: dict[str, int] = Field(description="readings that gave no frequency, by cause")
    packets_ignored: dict[str, int] = Field(
        description="undamaged packets without use, by cause: from before a reset, malformed, of unknown type, lines "
        "of the board's log beyond 20 a second"
    )
    bytes_in: int = Field(description="bytes from the board")
    bytes_by_outcome: dict[str, int] = Field(description="what became of them; their sum is `bytes_in`")
    connections: int = Field(description="openings of the link")
    host_overruns: int = Field(description="times that the driver of the host's serial port reported lost bytes")
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
    decoder: DecoderProcessInfo | None = Field(
        None, description="the process that decodes a skin; null where the daemon has none"
    )
    recording: RecordingInfo = Field(description="what is recorded, and was since the daemon started")
    commands: dict[str, int] = Field(
        default_factory=dict,
        description="commands since the daemon started, by what became of them: `done`, an error's code, `unanswered`",
    )
    messages: MessageAccount = Field(description=_MESSAGES)


class DecoderState(Message):
    """State of a decoder process, which may serve many plates."""

    decoder_id: str = Field(description="that of the topic, and of the messages it publishes")
    state: Condition = Field(description="one word")
    reason_code: ReasonCode = Field(ReasonCode.UNSPECIFIED, description="why, for programs")
    reason: str = Field(description="the same as a sentence for people, with details")
    t_ns: Int64 = Field(description="UTC, when it was published")
    since_t_ns: Int64 | None = Field(description="UTC, since when the state lasts; null in the last will")
    topic_filter: str = Field(description="the signals it takes")


class DecoderPlateHealth(Message):
    """What a decoder did with the signals of one plate; received = decoded + skipped + unusable + waiting."""

    received: int = Field(description="messages of `signals` since the decoder started")
    decoded: int = Field(description="published as `decoded` and `decoded/summary`")
    skipped: int = Field(description="a newer frame was there first, or the decoder was not ready")
    unusable: int = Field(description="not a message, another shape than in `info`, or the noise is not known yet")
    waiting: int = Field(description="being decoded, or next")
    missed: int = Field(description="gaps in `seq`; with a group: frames that others got, too")


class DecoderHealth(Message):
    """How a decoder process fares; once a second."""

    decoder_id: str = Field(description="that of the topic")
    t_ns: Int64 = Field(description="UTC, when it was made")
    uptime_s: float = Field(description="since the decoder started")
    plates: dict[str, DecoderPlateHealth] = Field(description="by plate")
    cpu_percent: Float = Field(description=_CPU + ", with its child process")
    rss_mb: Float = Field(description="memory of the decoder, with its child process")
    latency: dict[str, LatencyInfo] = Field(
        description="of `decoded`, of all plates, from the window to the hand-over, by UTC: clocks of two computers "
        "must agree"
    )
    messages: MessageAccount = Field(description=_MESSAGES)
