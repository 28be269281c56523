"""Tables of a plate file, each valid by itself."""

from __future__ import annotations

from datetime import date
from functools import partial
from operator import is_
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, Strict, StrictBool, ValidationInfo, field_validator

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats, Integers
from resonator_daemon.base.entry_points import entry_names
from resonator_daemon.base.toml import Count, Number, Table

FORCE_SIGNAL: Final = "force"
TEMPERATURE_SIGNAL: Final = "temperature"
FORCE_SIGNALS: Final = (FORCE_SIGNAL, TEMPERATURE_SIGNAL)
SKIN_SIGNALS = ("p_n", "eps_xz", "eps_yz")  # the order of everything that is published or decoded


def of_length(length: int, what: str, *, or_more: bool = False) -> BeforeValidator:
    """Return a validator of lists of this length; `what` names the items in its error.

    Unlike pydantic's min_length, it counts invalid items.
    """

    def check(values: object) -> object:
        if not isinstance(values, list | tuple) or len(values) < length or (len(values) > length and not or_more):
            raise ValueError(f"must be a list of {'at least ' if or_more else ''}{length}: {what}")
        return values

    return BeforeValidator(check)


_MIN_SENSITIVITY = 1e-15


def _nonzero(value: float) -> float:
    if abs(value) < _MIN_SENSITIVITY:
        raise ValueError("must not be zero: a site without sensitivity cannot be read; give the measured, signed value")
    return value


def _rising(limits: tuple[float, ...]) -> tuple[float, ...]:
    if not limits[0] < limits[1]:
        raise ValueError("must rise: the lowest, then the highest")
    return limits


Millimetres = Annotated[Number, Field(ge=-10_000, le=10_000)]
Point = Annotated[tuple[Millimetres, Millimetres], of_length(2, "x and y")]
Outline = Annotated[tuple[Point, ...], of_length(3, "corners, each [x, y]", or_more=True)]
Hertz = Annotated[Number, Field(ge=1, le=1e12)]
Sensitivity = Annotated[Number, Field(ge=-1e6, le=1e6), AfterValidator(_nonzero)]
Day = Annotated[date, Strict()]
Kelvin = Annotated[Number, Field(ge=100, le=600)]
Corners = of_length(CHANNEL_COUNT, "one for each corner")


CounterType = Literal["single-tone", "channelised"]


class Counter(Table):
    """Kind, clock and frame rate of the board's counter."""

    kind: CounterType
    reference_hz: Annotated[Hertz, Field(default_factory=lambda seen: _default(seen, 1e9, 250e6))]
    frame_rate_hz: Annotated[
        Number, Field(gt=0, le=100_000, default_factory=lambda seen: _default(seen, 1000.0, 100.0))
    ]
    pilot_hz: Hertz | None = None  # captured by a single-tone counter without touches; see Plate.pilot_hz
    codes_may_overlap: StrictBool = False  # accept a plate whose sites may be mistaken for each other
    # An entry of resonatord.sensors; None, which fingerprints of recordings omit: that of resonatord for the plate.
    sensor: str | None = Field(None, exclude_if=partial(is_, None))

    @property
    def frames_in_parts(self) -> bool:
        """Whether a frame is sent in parts, each with some tones of one channel, and not as one packet."""
        return self.kind == "channelised"

    @field_validator("pilot_hz")
    @classmethod
    def _only_a_single_tone_counter_has_a_pilot(cls, pilot_hz: float | None, info: ValidationInfo) -> float | None:
        if info.data.get("kind") == "channelised" and pilot_hz is not None:
            raise ValueError("belongs to a single-tone counter; leave it out")
        return pilot_hz

    @field_validator("sensor")
    @classmethod
    def _an_installed_package_has_the_sensor(cls, sensor: str | None) -> str | None:
        if sensor is not None and sensor not in (names := entry_names("sensors")):
            raise ValueError(f"no installed package has this kind of sensor; there are {', '.join(names)}")
        return sensor


def _default(seen: dict[str, Any], single_tone: float, channelised: float) -> float:
    return channelised if seen.get("kind") == "channelised" else single_tone


class Skin(Table):
    """The elastic half-space above the sites."""

    youngs_modulus_pascal: Annotated[Number, Field(ge=1, le=1e13)]
    poisson_ratio: Annotated[Number, Field(ge=0, le=0.5)]
    depth_mm: Annotated[Number, Field(ge=0.001, le=1000)]
    gain_std: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    correlation_length_mm: Annotated[Number, Field(ge=0.01, le=100)] = 1.0  # of the decoder's prior, ...
    tangential_ratio: Annotated[Number, Field(ge=0.001, le=100)] = 0.3  # ... likewise
    # Standard deviations of what the file states; of the gain, of all signals together.
    depth_std_mm: Annotated[Number, Field(ge=0, le=1000)] = 0.0
    modulus_std_pascal: Annotated[Number, Field(ge=0, le=1e13)] = 0.0
    gain_std_common: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    position_std_mm: Annotated[Number, Field(ge=0, le=1000)] = 0.0

    @property
    def depth_m(self) -> float:
        return self.depth_mm * 1e-3

    @property
    def correlation_length_m(self) -> float:
        return self.correlation_length_mm * 1e-3

    @property
    def depth_std_m(self) -> float:
        return self.depth_std_mm * 1e-3

    @property
    def position_std_m(self) -> float:
        return self.position_std_mm * 1e-3

    @property
    def exact_note(self) -> str | None:
        """Return a sentence if some of the skin is stated without an error, else None."""
        keys = ("depth_std_mm", "modulus_std_pascal", "gain_std_common", "position_std_mm")
        missing = ", ".join(key for key in keys if not getattr(self, key))
        return f"[skin] of the plate file does not state {missing}: contacts state no error for it" if missing else None


class Grid(Table):
    """Sites and tones of a skin by rule: tone k = (order . (ix, iy, signal)) mod tones lies at f0_hz + k spacing_hz."""

    shape: Annotated[tuple[Annotated[Count, Field(ge=1, le=65_535)], ...], of_length(2, "ny and nx")]
    pitch_mm: Annotated[Number, Field(gt=0, le=1000)]
    signals: Annotated[tuple[Literal["p_n", "eps_xz", "eps_yz"], ...], of_length(3, "p_n, eps_xz and eps_yz")]
    f0_hz: Hertz
    spacing_hz: Hertz
    order: Annotated[tuple[Count, ...], of_length(3, "steps for ix, iy and the signal")]
    sensitivity: Annotated[tuple[Sensitivity, ...], of_length(3, "one for each signal")]

    @property
    def pitch_m(self) -> float:
        return self.pitch_mm * 1e-3

    @property
    def tone_count(self) -> int:
        return self.shape[0] * self.shape[1] * len(self.signals)

    @property
    def site_positions_mm(self) -> Floats:
        """(ny nx, 2), site index iy nx + ix, centred on the plate's origin."""
        ny, nx = self.shape
        iy, ix = np.divmod(np.arange(ny * nx), nx)
        return np.column_stack([ix - (nx - 1) / 2, iy - (ny - 1) / 2]) * self.pitch_mm

    @property
    def tone_numbers(self) -> Integers:
        """(ny nx, signals) the number k of each tone."""
        ny, nx = self.shape
        step_x, step_y, step_signal = (step % self.tone_count for step in self.order)
        iy, ix = np.divmod(np.arange(ny * nx, dtype=np.int64)[:, None], nx)
        signal = np.arange(len(self.signals), dtype=np.int64)
        numbers: Integers = (step_x * ix + step_y * iy + step_signal * signal) % self.tone_count
        return numbers


class Tone(Table):
    """One resonance of a site, as the four corners receive it."""

    signal: Literal["force", "temperature", "p_n", "eps_xz", "eps_yz"]
    f0_hz: Annotated[tuple[Hertz, ...], Corners]
    sensitivity: Annotated[tuple[Sensitivity, ...], Corners]
    # Relative shift by d = T - thermal.reference_kelvin: a d + b d^2 + c d^3, in 1/K, 1/K^2, 1/K^3.
    temperature_coefficients: Annotated[tuple[Number, ...], of_length(3, "a, b and c")] | None = None


class Site(Table):
    """One sensing place of the plate: a force (and its temperature), or the three signals under a skin."""

    id: Annotated[Count, Field(ge=1, le=65_535)]
    position_mm: Point
    tones: Annotated[tuple[Tone, ...], of_length(1, "[[sites.tones]]", or_more=True)]


class Thermal(Table):
    """Temperatures of plate and touches, and their effect on tones, with uncertainties."""

    reference_kelvin: Kelvin = 298.15  # at which f0_hz holds
    range_kelvin: Annotated[tuple[Kelvin, ...], of_length(2, "lowest and highest"), AfterValidator(_rising)] = (
        288.15,
        308.15,
    )
    coefficient_std: Annotated[Number, Field(ge=0, le=1e-3)] = 2e-8  # 1/K, of the errors of the tones' coefficients
    transient_s: Annotated[Number, Field(ge=-1, le=1)] = -2e-7  # relative shift for each K/s of a site
    contact_std_kelvin: Annotated[Number, Field(ge=0, le=1000)] = 0.0  # of a touching object against the plate
    contact_time_s: Annotated[Number, Field(gt=0, le=1e6)] = 5.0  # time constant of a touched site's temperature


class Response(Table):
    """Hysteresis and creep of a force site, as calibrated."""

    hysteresis_newton: Annotated[Number, Field(ge=0, le=10_000)]
    creep_fraction: Annotated[Number, Field(ge=0, lt=0.5)]
    creep_time_s: Annotated[Number, Field(gt=0, le=1e6)]
    relative_std: Annotated[Number, Field(ge=0, le=1)] = 0.1  # relative, of the three values above


class Validity(Table):
    """Ranges of force and temperature in which a calibration was made."""

    force_newton: Annotated[tuple[Number, ...], of_length(2, "lowest and highest"), AfterValidator(_rising)]
    kelvin: Annotated[tuple[Kelvin, ...], of_length(2, "lowest and highest"), AfterValidator(_rising)]


class Coupling(Table):
    """Share of the force on the site `pressed` that the site `measured` measures."""

    pressed: Count
    measured: Count
    ratio: Number


class Calibration(Table):
    """Origin, validity and uncertainty of the numbers in this file."""

    id: str | None = None
    date: Day | None = None
    unit: str | None = None  # serial number of the board and plate that were calibrated
    temperature_kelvin: Kelvin | None = None
    model_error: Annotated[Number, Field(gt=0, le=0.5)] = 0.015  # relative, of K from touch to touch and corner
    sensitivity_std: Annotated[Number, Field(ge=0, le=0.5)] = 0.0  # relative, common to all K: error of the masses
    sites: tuple[Count, ...] = ()  # ids of those that were calibrated last, in the order of `residuals`
    residuals: tuple[Number, ...] = ()  # newton rms
    coupling: tuple[Coupling, ...] = ()
    validity: Validity | None = None
    expiry: Day | None = None

    def expired(self, today: Day) -> bool:
        return self.expiry is not None and today > self.expiry

    def expiry_note(self, today: Day) -> str | None:
        """Return a sentence if the calibration has expired, else None."""
        name = self.id or "of the plate file"
        return f"calibration {name} expired on {self.expiry}: calibrate again" if self.expired(today) else None
