"""What all payloads are made of: numbers that may be unknown, units, arrays, closed sets of words, and the header.

Floats that are not known are NaN here and null in JSON. 64-bit integers are decimal strings in JSON, because many
readers of JSON hold numbers as doubles, exact only to 2^53.
"""

import json
import math
from functools import partial
from operator import is_, not_
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, PlainValidator, WithJsonSchema

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.reasons import Word

_TABLES: Final = json.loads(Path(__file__).with_name("units.json").read_text(encoding="utf-8"))
UNITS: Final[dict[str, str]] = _TABLES["units"]
"""Unit by the ending of a key, in the notation of UCUM; a tick is one of the board's clock."""

DIMENSIONLESS: Final = frozenset[str](_TABLES["dimensionless"])
"""Keys of numbers without a unit, without the `_std` or `_systematic` that a standard deviation has at its end."""

NO_UNIT: Final = "1"
AXES: Final = "xyz"


def unit_of(key: str) -> str | None:
    """Return the unit of a key's numbers: that of the longest ending in `UNITS`, without `_std`; None for others."""
    bare = key.removesuffix("_std").removesuffix("_systematic")
    if bare in DIMENSIONLESS:
        return NO_UNIT
    parts = bare.split("_")
    endings = ("_".join(parts[start:]) for start in range(1, len(parts)))
    return next((UNITS[ending] for ending in endings if ending in UNITS), None)


def with_axis(name: str, axis: str) -> str:
    """Return the name of a vector's component: its letter before the unit, as `force_x_newton`."""
    parts = name.split("_")
    for start in range(1, len(parts)):
        if "_".join(parts[start:]) in UNITS:
            return "_".join((*parts[:start], axis, *parts[start:]))
    return f"{name}_{axis}"


_DECIMAL: Final = {"type": "string", "pattern": "^[0-9]{1,20}$"}
_DIGITS: Final = 2  # of a standard deviation: further ones are noise


def _nested_rows(*shapes: str, row: dict[str, Any]) -> dict[str, Any]:
    elements = {"tag": 85, "type": "float32, little-endian"}
    typed_array = {"tag": 40, "shape": list(shapes), "elements": elements}
    return {"type": "array", "minItems": 3, "maxItems": 3, "items": row, "x-rfc8746": typed_array}


_SIGNAL_ROWS: Final = _nested_rows("[3, n]", row={"type": "array", "items": {"type": "number"}})
# Numbers or rows of numbers: a choice of types would give generators one that reads neither.
_MAP_ROWS: Final = _nested_rows("[3, n]", "[3, ny, nx]", row={"type": "array"})


def _float32(value: Any) -> NDArray[np.float32]:
    if not isinstance(value, np.ndarray) or value.ndim not in (2, 3) or value.shape[0] != 3:
        raise ValueError(f"{np.shape(value)}: must be an array of shape (3, n) or (3, ny, nx)")
    return np.asarray(value, "<f4")


Int64 = Annotated[
    int,
    Field(ge=0, lt=2**64),
    PlainSerializer(str, when_used="json"),
    WithJsonSchema(_DECIMAL, mode="serialization"),
]
_MAY_BE_UNKNOWN: Final = (
    BeforeValidator(lambda value: math.nan if value is None else value),
    WithJsonSchema({"type": ["number", "null"]}, mode="serialization"),
)
Float = Annotated[float, *_MAY_BE_UNKNOWN]
OptionalFloat = Annotated[float | None, *_MAY_BE_UNKNOWN]
"""A number that may be unknown, of a key that may be left out: then None."""
Vector2 = tuple[Float, Float]
Vector3 = tuple[Float, Float, Float]
PerChannel = Annotated[tuple[Float, ...], Field(min_length=CHANNEL_COUNT, max_length=CHANNEL_COUNT)]
Float32Array = Annotated[NDArray[np.float32], PlainValidator(_float32), WithJsonSchema(_MAP_ROWS)]
SignalArray = Annotated[Float32Array, WithJsonSchema(_SIGNAL_ROWS)]


class Status(Word):
    """What a number is worth; where it is not "ok" and no number is given, this is the reason."""

    OK = "ok", "as good as its stated uncertainty"
    SETTLING = "settling", "the window is not full yet, as after the start and when the captured tone has changed"
    CONSTRAINT_DROPPED = "constraint_dropped", "contact physics given up for this frame, the linear map is shown"
    CONTRADICTED = "contradicted", "the signals contradict the model of the contact: errors exceed what is stated"
    AMBIGUOUS = "ambiguous", "two sites explain the readings about equally well"
    REJECTED = "rejected", "no load explains the readings"
    POSSIBLY_MORE = "possibly_more", "a second touch cannot be excluded"
    OVERLOAD = "overload", "beyond the plate's range: the force is null, `at_least_newton` is given"
    NO_SIGNAL = "no_signal", "no tone, or too few, are detected"
    PILOT_LOST = "pilot_lost", "the untouched reference tone is not detected"
    UNCALIBRATED = (
        "uncalibrated",
        "beyond the forces or temperatures that the calibration covers, or later than its expiry: "
        "force and errors are guesses",
    )
    PRESSED_AT_START = "pressed_at_start", "touched before the untouched plate was known: no force can be given"


class Baseline(Word):
    """How the frequencies of the untouched plate are known."""

    FOLLOWED = "followed", "from tones that nothing touches"
    HELD = "held", "as they were; no untouched tone is detected"
    UNKNOWN = "unknown", "not known yet"


class ResponseCompensation(Word):
    """Whether hysteresis and creep of the sites are taken out."""

    ON = "on", "hysteresis and creep are taken out"
    OFF = "off", "they were not calibrated; `systematic_newton` includes their typical size"


class CapturedTone(Word):
    """What tone a corner has captured."""

    NONE = "none", "no tone can be counted, or not for a whole window yet; `reason_code` states which"
    PILOT = "pilot", "that of the untouched plate"
    SITE = "site", "that of the site in `site`"
    UNIDENTIFIED = "unidentified", "another tone, which is not assigned to a site; the message's `status` states why"


class ContactShape(Word):
    """The object whose model explains the signals of a contact."""

    BALL = "ball", "a paraboloid"
    PUNCH = "punch", "a flat round face"
    ELLIPSE = "ellipse", "a paraboloid with two radii of curvature"


class ContactChange(Word):
    """What happens to a contact."""

    ONSET = "onset", "it begins"
    RELEASE = "release", "it ends; `reason` states why"
    INCIPIENT_SLIP = "incipient_slip", "under a skin: its margin to slip has fallen below 0.3"
    GROSS_SLIP = "gross_slip", "under a skin: no margin is left, all of it slips"


class CounterType(Word):
    """Kind of the board's counter."""

    SINGLE_TONE = "single-tone", "one captured tone per corner"
    CHANNELISED = "channelised", "one tone per site and corner"


def optional(description: str) -> Any:
    """Return the field of a key that a message leaves out where it has no value: None here."""
    return Field(None, exclude_if=partial(is_, None), description=description)


def optional_number(description: str) -> Any:
    """Return the field of a key that a message leaves out where its number is 0."""
    return Field(0, exclude_if=not_, description=description)


class Message(BaseModel):
    """Base of every payload and its parts; unknown keys are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True)


class Lost(Message):
    """Losses since the daemon started, by cause; a cause without any is left out."""

    link_gap: int = optional_number("frames that the board sent and that never arrived")
    damaged: int = optional_number("frames that arrived with a wrong checksum")
    board_overflow: int = optional_number("frames that the board discarded")
    host_overrun: int = optional_number("frames that the driver of the host's serial port lost")
    queue_overflow: int = optional_number("frames that the daemon discarded before measuring")
    publish_dropped: int = optional_number(
        "messages that were never written to the broker, without states that a newer one replaced and without late "
        "messages"
    )
    skipped_late: int = optional_number(
        "messages that were late: more than 75 ms after the window while newer frames wait, 400 ms in any case, or "
        "250 ms in the queue to the broker. Of a skin also frames that the decoder skipped for newer ones"
    )


class Header(Message):
    """Carried by every message of a daemon."""

    name: str = Field(description="name of the plate, as in the topic")
    seq: int = Field(
        description="number of the message on its topic since the daemon started; a larger step is messages that were "
        "lost, skipped, or left out to lower the rate"
    )
    daemon_boot_id: str = Field(description="new with each start of the daemon")
    t_ns: Int64 = Field(description="UTC: of measured messages the middle of the window, of others when they were made")
    t_uncertainty_ns: int = Field(description="bound of the error of `t_ns`")
    lost: Lost = Field(description="losses since the daemon started, by cause")


class BoardHeader(Header):
    """Header of what describes the daemon with its board."""

    board_boot_id: str | None = Field(
        description="new with each start of the board; null until the board has reported it"
    )


class Measured(Header):
    """Header of what was measured."""

    board_ticks: Int64 | None = Field(
        description="the board's clock at the end of the last gate in the window, null where it is not known; it starts"
        " again with each `board_boot_id` of `state/link`"
    )


def rounded(value: float, std: float) -> float:
    """Return `value` to a hundredth of its standard deviation or better, unchanged where that is not known."""
    return round(value, _DIGITS - math.floor(math.log10(std))) if 0.0 < std < math.inf else value


def rounded_std(std: float, digits: int = _DIGITS + 1) -> float:
    """Return a standard deviation, or another number of its own scale, to some digits."""
    size = abs(std)
    return round(std, digits - 1 - math.floor(math.log10(size))) if 0.0 < size < math.inf else std
