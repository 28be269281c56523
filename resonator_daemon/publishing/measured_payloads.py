"""Messages about what presses on a plate: forces, contacts, and what a skin senses and a decoder makes of it."""

import math
from typing import Self

from pydantic import Field, model_validator

from resonator_daemon.publishing.payload_types import (
    Float,
    Float32Array,
    Int64,
    Measured,
    Message,
    PerChannel,
    SignalArray,
    Status,
    Vector2,
    Vector3,
)
from resonator_daemon.publishing.words import Baseline, ContactChange, ResponseCompensation

_NOISE = "one standard deviation of what averages out, from the counts themselves"
_SYSTEMATIC = (
    "one standard deviation of what does not: calibration, drift, warm touches, the site's response; null under a skin"
)
_AT_LEAST = "with the status `overload`: the force is at least this; else null"
_DECODER_ID = "the process that decoded; null: the daemon itself"
_FOLLOWER_ID = "the process that follows the contacts, and numbers them; null: the daemon itself"
_EMPTY_REASON = "empty where there is none"


class SiteForce(Message):
    """Force on one site."""

    site: int = Field(description="number of the site in the plate file")
    force_newton: Float = Field(description="force on the site; null with a reason in `status`")
    noise_newton: Float = Field(description=_NOISE)
    systematic_newton: Float = Field(description=_SYSTEMATIC)
    hidden_newton: Float = Field(
        0.0,
        description="a bound, and no part of the two before: the most that a touch between sites may have put on "
        "others, in addition to `force_newton`; 0 where sites are touched one by one or all of them are detected",
    )
    status: Status = Field(description="what this force is worth")
    at_least_newton: float | None = Field(None, description=_AT_LEAST)


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
        description="temperature of the plate above `thermal.reference_kelvin`, as the tones show it; null on "
        "single-tone counters. Changes are known far better than the value"
    )
    plate_kelvin_std: Float = Field(
        description="its standard deviation; near 20 K where nothing but changes was seen, or where all sites have "
        "the same coefficients"
    )
    response: ResponseCompensation = Field(description="whether hysteresis and creep of the sites are taken out")


class Forces(Measured):
    """Forces on the touched sites in one window."""

    window_s: float = Field(description="length of the window that was counted; shorter just after an onset")
    status: Status = Field(description="of the whole message: why sites may be missing")
    reason: str = Field(description="why; `ok` may have one, too, as channels without a signal; " + _EMPTY_REASON)
    sites: tuple[SiteForce, ...] = Field(description="those on which something presses")
    beats: tuple[int, ...] = Field(
        description="channels whose tone beats with the board's reference clock; `noise_newton` counts for that"
    )
    compensation: Compensation = Field(description="what was taken out before frequencies became forces")


class Contact(Message):
    """One touch, from its onset to its release under one id."""

    id: int = Field(description="the same from onset to release; never used again by this run of the daemon")
    site: int = Field(description="the nearest site")
    position_m: Vector2 = Field(description="x and y in the plate's plane; of a single-tone counter the site's place")
    position_std_m: Vector2 = Field(
        description="standard deviation of each; of a single-tone counter the spread of all places that are nearest "
        "to the site"
    )
    position_correlation: Float = Field(description="of the errors of x and y, -1 to 1; null under a skin")
    force_newton: Float = Field(description="force; under a skin normal to it; null with a reason in `status`")
    noise_newton: Float = Field(description=_NOISE)
    systematic_newton: Float = Field(description=_SYSTEMATIC)
    hidden_newton: Float = Field(0.0, description="as of a site in `forces`")
    peak_newton: Float = Field(description="the greatest force of the contact so far")
    since_t_ns: Int64 = Field(description="its onset, UTC")
    duration_s: Float = Field(description="from the onset to the last reading that gave its force")
    status: Status = Field(description="what this contact's numbers are worth")
    reason: str = Field("", description=_EMPTY_REASON)
    at_least_newton: float | None = Field(None, description=_AT_LEAST)


class EventContact(Contact):
    """A contact in an event; what belongs to slip is null on plates without a skin, or not known."""

    slip_margin: Float = Field(math.nan, description="1 - F_t / (mu F_n): 1 without shear, 0 where it slips")
    slip_margin_std: Float = Field(math.nan, description="its standard deviation")
    friction_coefficient: Float = Field(math.nan, description="mu")


class Contacts(Measured):
    """All present contacts."""

    status: Status = Field(description="of the whole message")
    reason: str = Field("", description=_EMPTY_REASON)
    contacts: tuple[Contact, ...] = Field(description="all present contacts")
    decoder_id: str | None = Field(None, description=_FOLLOWER_ID)


class ContactEvent(Measured):
    """A contact begins, ends or slips."""

    event: ContactChange = Field(description="what happens")
    reason: str = Field(
        "",
        description="why a contact is released, empty for other events: its force has fallen, it is `no longer felt`, "
        "under a skin it was not found in 3 frames in a row or its decoder was set up again or failed, "
        "nothing was known of it for too long, no frames or signals came for 0.5 s, or the board restarted",
    )
    contact: EventContact = Field(
        description="its last state: the force of one that is no longer felt may be null already"
    )
    decoder_id: str | None = Field(None, description=_FOLLOWER_ID)
    replayed: bool = Field(
        False,
        description="it waited for a broker, or may have come before: a double has the same `daemon_boot_id`, "
        "`decoder_id` and `seq`",
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
    decoder_id: str | None = Field(None, description=_DECODER_ID)

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        _check_shapes(self, "traction_pascal", "traction_std_pascal", "displacement_m")
        return self


class Patch(Message):
    """One contact on a skin; components x, y, z, moments about the origin of the plate's coordinates.

    What only a fit of the contact yields is null where the fit does not hold, or the contact slips too little to show.
    """

    id: int | None = Field(
        description="as in `contacts`, from onset to release; null where many decoders share a skin: none of them sees "
        "all frames"
    )
    centroid_m: Vector2 = Field(description="x and y, of the pressure; of the map, which is blurred")
    centroid_std_m: Vector2 = Field(description="standard deviation of each")
    area_m2: Float = Field(description="of the pressed part of the map")
    force_newton: Vector3 = Field(description="x, y, z")
    force_std_newton: Vector3 = Field(description="standard deviation of each")
    moment_newton_m: Vector3 = Field(description="x, y, z, about the origin of the plate's coordinates")
    moment_std_newton_m: Vector3 = Field(description="standard deviation of each")
    at_border: bool = Field(description="part of the contact may lie beyond the sites")
    radius_of_curvature_m: Float = Field(description="of the object, taken as a paraboloid")
    stick_ratio: Float = Field(
        description="radius of the part that sticks over the radius of contact, from a fit to the signals"
    )
    slip_margin: Float = Field(description="1 - F_t / (mu F_n): 1 without shear, 0 where it slips")
    slip_margin_std: Float = Field(description="its standard deviation")
    friction_coefficient: Float = Field(
        description="mu, where known to a quarter: from stick radius and forces of this frame and an estimate from "
        "before; a configured one counts as known to 3 %"
    )
    friction_coefficient_std: Float = Field(description="its standard deviation")
    slip_reason: str = Field(description="why those of the fit are not known; empty where they are")


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
    reason: str = Field(
        description="`ok` may have one, too: lost signals, matrices that are being prepared, a fit in place of a map; "
        + _EMPTY_REASON
    )
    patches: tuple[Patch, ...] = Field(description="the contacts")
    decoder_id: str | None = Field(None, description=_DECODER_ID)


def _check_shapes(message: Message, first: str, *others: str) -> None:
    shape = getattr(message, first).shape
    for name in others:
        array = getattr(message, name)
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, must be that of {first}, {shape}")
