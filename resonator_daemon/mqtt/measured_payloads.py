"""Messages about what presses on a plate: forces, contacts, and what a skin senses and a decoder makes of it."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.mqtt.payload_types import (
    Baseline,
    CapturedTone,
    ContactChange,
    Float,
    Float32Array,
    Int64,
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


class Contact(Message):
    """One touch, from its onset to its release under one id; components x, y, z.

    Moments and slip are keys of skins alone, `systematic_newton` of force sites.
    """

    id: int | None = Field(description="the same from onset to release; null if many decoders share a skin")
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
    systematic_newton: OptionalFloat = optional(
        "of the normal force: one standard deviation of what does not average out: calibration, drift, warm touches, "
        "the site's response"
    )
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


class Signals(Measured):
    """What the sites of a skin sense."""

    signals: SignalArray = Field(
        description="float32 [3, n] in the order of the sites, rows 3 p_n / (2 E), eps_xz, eps_yz; NaN where not known"
    )
    noise_std: SignalArray = Field(description="standard deviation of each, same shape; NaN where not known")
    status: Status = Field(description="of the frame; `ok` alone is fit for decoding")

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        _check_shapes(self, "signals", "noise_std")
        return self


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
    grid: Grid | None = Field(
        description="where the values lie; null at scattered points: those of the sites, in the order of `info`"
    )
    decoder_id: str | None = optional(_DECODER_ID)

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        _check_shapes(self, "traction_pascal", "traction_std_pascal", "displacement_m")
        return self


class Patch(Message):
    """What the map shows of one contact beyond its message in `contacts`.

    What only a fit of the contact yields is null where the fit does not hold, or the contact slips too little to show.
    """

    id: int | None = Field(description="as in `contacts`, whose order is the same")
    area_m2: Float = Field(description="of the pressed part of the map")
    at_border: bool = Field(description="part of the contact may lie beyond the sites")
    radius_of_curvature_m: Float = Field(description="of the object, taken as a paraboloid")
    stick_ratio: Float = Field(
        description="radius of the part that sticks over the radius of contact, from a fit to the signals"
    )


class DecodedSummary(Measured):
    """What the map shows, in few numbers, and how well the decoder's model explains the frame."""

    decoder: str = Field(
        description="what made the map: `open-plane` or `fourier`, with `+contact` where contact physics is on; "
        "`template` where sites are too few for a map"
    )
    chi2: Float = Field(
        description="about 1 where the signals scatter as the decoder's model and the declared noise predict"
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


def _check_shapes(message: Message, first: str, *others: str) -> None:
    shape = getattr(message, first).shape
    for name in others:
        array = getattr(message, name)
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, must be that of {first}, {shape}")
