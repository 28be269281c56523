"""Readings of one window: forces and contacts of force sites, signals of a skin, and their compensation."""

from dataclasses import dataclass
from typing import Literal

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.forces.contacts import Contact, ContactEvent
from resonator_daemon.estimate.forces.site_identification import SiteForce

SensorStatus = Literal[
    "ok",
    "settling",
    "no_signal",
    "pilot_lost",
    "pressed_at_start",
    "ambiguous",
    "rejected",
    "overload",
    "possibly_more",
    "uncalibrated",
]


@dataclass(slots=True)  # not frozen, which takes three times as long to make: one for each reading
class Compensation:
    """Compensation applied to the frequencies before their conversion to forces.

    `common_mode` is the relative frequency error taken out of each channel, `common_mode_std` what it may be off by.
    `baseline` is how it is known: "followed" from an untouched plate or from untouched tones, "held" during a touch,
    "unknown". `plate_kelvin` is the plate's temperature against its calibration's as the tones show it, NaN where none
    does. `response` is "on" if hysteresis and creep are taken out.
    """

    common_mode: tuple[float, ...]
    common_mode_std: float
    baseline: Literal["followed", "held", "unknown"]
    plate_kelvin: float
    plate_kelvin_std: float
    response: Literal["on", "off"]


CapturedTone = Literal["none", "pilot", "site", "unidentified"]


@dataclass(frozen=True, slots=True)
class CornerTone:
    """Tone that one corner captured, common mode taken out; NaN where it is not known.

    `site`, an index, is None unless a site's tone is `captured`. `noise_hz`, one standard deviation, is that of counter
    and oscillator. `residual` is the tone's relative shift less that of the identified force, over its standard error.
    """

    captured: CapturedTone
    site: int | None
    frequency_hz: float
    noise_hz: float
    residual: float
    reason_code: ReasonCode | None = None


@dataclass(slots=True)  # not frozen, which takes three times as long to make: one for each step
class ForceReading:
    """Forces and contacts from one window; NaN or absent where unknown, with `status` and `reason`.

    `board_ticks` is the end of the last gate in the window. `at_step` is false between two steps, where only events
    are new. `beats` are channels whose tone beats with the counter's reference: their noise counts for more. `tones`
    are those of the corners, where they are due.
    """

    sequence: int
    board_ticks: int
    window_s: float
    at_step: bool
    status: SensorStatus
    reason: Reason | None
    sites: tuple[SiteForce, ...]
    contacts: tuple[Contact, ...]
    events: tuple[ContactEvent, ...]
    compensation: Compensation
    beats: tuple[int, ...] = ()
    tones: tuple[CornerTone, ...] | None = None


@dataclass(frozen=True, slots=True)
class SkinReading:
    """Signals of one frame, the dimensionless triple [3 p_n / (2 E), eps_xz, eps_yz] and its noise, both (3, sites).

    `board_ticks` is the end of the gate. NaN where not known, with the cause in `status` and `reason`. `at_rest`: the
    skin has been untouched for so long that readings to come are those of any beginning before.
    """

    sequence: int
    board_ticks: int
    window_s: float
    status: SensorStatus
    reason: Reason | None
    signals: Floats
    noise_std: Floats
    common_mode: float
    at_rest: bool = False
