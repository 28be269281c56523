"""The configuration file of one board, checked once with its plate file: every finding at once."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import parse_qsl, quote

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    ModelWrapValidatorHandler,
    PlainValidator,
    StrictBool,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic_core import InitErrorDetails

from firmware_protocol.layouts import BLOCK_STRUCT, CHANNEL_COUNT, SINGLE_TONE_STRUCT, TONE_STRUCT
from firmware_protocol.packets import MAX_PAYLOAD_BYTES, PACKET_OVERHEAD_BYTES
from resonator_daemon.errors import ConfigError
from resonator_daemon.mqtt_settings import Mqtt as Mqtt
from resonator_daemon.mqtt_settings import split_url
from resonator_daemon.mqtt_settings import topic_level as topic_level
from resonator_daemon.places import state_directory
from resonator_daemon.plate import Plate, load_plate
from resonator_daemon.toml_file import Number, Table, check_with, finding, load_model, nearest, read_toml

_BITS_PER_BYTE = 10  # on a serial line: start bit, 8 data bits, stop bit
DECODER = "decoder"  # level of the topics of decoder processes, which no plate can have as a name
_EXAMPLE = """\
name = "left-index"                      # topics: resonator/left-index/...; default: the board's serial number
plate = "quartz16"                       # a shipped plate or a path, relative to this file
link = "serial:/dev/serial/by-id/usb-RD_board_0042-if00?baud=4000000"   # or tcp://host:port, usb:1209:0001?serial=0042
[mqtt]
url = "mqtt://127.0.0.1:1883"            # mqtts:// for TLS; username, password_file and certificates: docs/security.md
prefix = "resonator"
[measurement]
window_ms = 10
step_ms = 5                              # publishing rate of forces and contacts: 200 Hz
[decoding]
method = "open-plane"                    # fourier, off
contact_physics = true
friction_coefficient = "unknown"         # or a number
[commands]
allow = ["tare"]                         # of subscribers; those that change nothing are always obeyed
"""


@dataclass(frozen=True)
class SerialLink:
    """A board on a serial port."""

    path: str
    baud: int

    def __str__(self) -> str:
        return f"serial:{self.path}?baud={self.baud}"


@dataclass(frozen=True)
class TcpLink:
    """A board that listens on the network."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"


@dataclass(frozen=True)
class UsbLink:
    """A board on a USB bus; without a serial number the only one of its vendor and product."""

    vendor_id: int
    product_id: int
    serial_number: str | None = None
    reset: bool = False  # whether the device may be reset as the last step, when it stays silent

    def __str__(self) -> str:
        options = {"serial": self.serial_number, "reset": "yes" if self.reset else None}
        query = "&".join(f"{key}={quote(value, safe='')}" for key, value in options.items() if value is not None)
        return f"usb:{self.vendor_id:04x}:{self.product_id:04x}" + (f"?{query}" if query else "")


@dataclass(frozen=True)
class ReplayLink:
    """A recording of a link, in place of one."""

    path: str

    def __str__(self) -> str:
        return f"replay:{self.path}"


LinkTarget = SerialLink | TcpLink | UsbLink | ReplayLink


def parse_link(text: object) -> LinkTarget:
    """Parse `serial:PATH?baud=N`, `tcp://host:port`, `usb:VID:PID?serial=S`, `replay:FILE`; ValueError says why not."""
    if not isinstance(text, str):
        raise ValueError("must be a string: serial:PATH?baud=N, tcp://host:port, usb:VID:PID?serial=S or replay:FILE")
    scheme, _, rest = text.partition(":")
    match scheme:
        case "serial":
            return _serial_link(rest)
        case "tcp":
            url = split_url(text)
            if not url.hostname or url.port is None or url.netloc.count("@") or url.path or url.query or url.fragment:
                raise ValueError("must be tcp://host:port, nothing more")
            return TcpLink(url.hostname, url.port)
        case "usb":
            return _usb_link(rest)
        case "replay":
            if not rest or "\0" in rest:
                raise ValueError("must be replay:FILE, a file that `resonatord record` has written")
            return ReplayLink(rest)
        case _:
            raise ValueError(f"no link is called {scheme!r}; {nearest(scheme, ['serial', 'tcp', 'usb', 'replay'])}")


def _serial_link(rest: str) -> SerialLink:
    path, _, query = rest.partition("?")
    baud = _options(query, ["baud"]).get("baud", "")
    if not path or "\0" in path or not (baud.isascii() and baud.isdecimal() and 0 < int(baud[:12]) <= 1e9):
        raise ValueError("must be serial:PATH?baud=N with N from 1 to 1e9, as serial:/dev/ttyACM0?baud=4000000")
    return SerialLink(path, int(baud))


def _usb_link(rest: str) -> UsbLink:
    ids, question, query = rest.partition("?")
    found = re.fullmatch(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})", ids)
    if found is None or (question and not query):
        raise ValueError(
            "must be usb:VID:PID?serial=S, ids of four hexadecimal digits as lsusb shows them, "
            "as usb:1209:0001?serial=0042"
        )
    options = _options(query, ["serial", "reset"])
    serial_number = options.get("serial")
    if serial_number is not None and (not serial_number.isprintable() or not 0 < len(serial_number) <= 126):
        raise ValueError("serial must be 1 to 126 printable characters, as in the device's string descriptor")
    if (reset := options.get("reset", "no")) not in ("yes", "no"):
        raise ValueError(f"reset must be yes or no, got {reset!r}")
    return UsbLink(int(found[1], 16), int(found[2], 16), serial_number, reset == "yes")


def _options(query: str, allowed: list[str]) -> dict[str, str]:
    """Return the options of a link, each named once."""
    pairs = parse_qsl(query, keep_blank_values=True)
    for position, (key, _) in enumerate(pairs):
        if key not in allowed:
            raise ValueError(f"no option is called {key!r}; {nearest(key, allowed)}")
        if key in (other for other, _ in pairs[:position]):
            raise ValueError(f"{key} is given twice")
    return dict(pairs)


def plate_name(text: str) -> str:
    """Return the text if plates can publish under it; ValueError says why not."""
    if text == DECODER:
        raise ValueError("is the topic of decoder processes; choose another")
    if text in (".", ".."):
        raise ValueError("becomes a directory of its own; choose another")
    return topic_level(text)


def _directory(value: object, info: ValidationInfo) -> Path:
    if not isinstance(value, str) or not value or "\0" in value:
        raise ValueError("must be a string: a directory, relative to this file or absolute")
    return (info.context or Path()) / value


def _plates(names: tuple[str, ...]) -> tuple[str, ...]:
    if "+" in names and len(names) > 1:
        raise ValueError('"+" stands for all plates; name them or give it alone')
    if len(set(names)) < len(names):
        raise ValueError("must not name a plate twice")
    for name in names:
        if name != "+":
            plate_name(name)
    return names


def _friction(value: object) -> object:
    if value == "unknown":
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError("must be 'unknown' or a number above 0, at most 10")
    return value


Verb = Literal["tare", "start_recording", "stop_recording", "mark", "set_window", "set_rate", "identify"]


class Commands(Table):
    """What subscribers may have the daemon do; `ping`, `health` and `snapshot`, which change nothing, always."""

    allow: tuple[Verb, ...] = ()


class Recording(Table):
    """Where recordings go that a command starts."""

    directory: Annotated[Path, BeforeValidator(_directory)] = Field(
        default_factory=lambda: state_directory() / "recordings"
    )


class Measurement(Table):
    """How long to count for one force, and how often to publish one."""

    window_ms: Annotated[Number, Field(gt=0, le=1000)] = 10.0
    step_ms: Annotated[Number, Field(gt=0, le=1000)] = 5.0

    @property
    def window_s(self) -> float:
        return self.window_ms * 1e-3

    @property
    def step_s(self) -> float:
        return self.step_ms * 1e-3


class Decoding(Table):
    """How signals under a skin are taken back to its surface."""

    method: Literal["open-plane", "fourier", "off"] = "open-plane"
    contact_physics: StrictBool = True
    friction_coefficient: Annotated[Annotated[Number, Field(ge=0.001, le=10)] | None, BeforeValidator(_friction)] = None
    uncertainty: StrictBool = True  # in `decoded`, the standard deviation of the traction
    displacement: StrictBool = True  # in `decoded`, too
    apart: StrictBool = False  # the daemon publishes signals alone, `resonatord decode` takes them on
    plates: Annotated[tuple[str, ...], AfterValidator(_plates)] = ()  # of decoders that share them; else `name`
    group: Annotated[Annotated[str, AfterValidator(topic_level)] | None, Field(validate_default=True)] = None

    @field_validator("group")
    @classmethod
    def _group_shares_plates(cls, group: str | None, info: ValidationInfo) -> str | None:
        plates = info.data.get("plates")
        if plates and group is None:
            raise ValueError("missing; decoders of the same group share the plates, each frame goes to one of them")
        if plates == () and group is not None:
            raise ValueError('shares plates that are named in decoding.plates, as plates = ["+"]; there are none')
        return group


def _plate(value: object, info: ValidationInfo) -> Plate:
    """Load the plate that a configuration names, relative to the configuration's directory."""
    if not isinstance(value, str):
        raise ValueError("must be a string: the name of a shipped plate or a path")
    try:
        return load_plate(value, relative_to=info.context)
    except ConfigError as error:
        findings = [finding((), value, message) for message in error.messages]
        raise ValidationError.from_exception_data("plate", findings) from None


class Config(Table):
    """One board: its plate, its link, and what to do with its counts."""

    name: Annotated[str, Field(max_length=100), AfterValidator(plate_name)] | None = None  # default: serial number
    plate: Annotated[Plate, PlainValidator(_plate)]
    link: Annotated[LinkTarget, PlainValidator(parse_link)]
    mqtt: Mqtt = Mqtt()
    measurement: Annotated[Measurement, Field(validate_default=True)] = Measurement()
    decoding: Decoding = Decoding()
    commands: Commands = Commands()
    recording: Recording = Field(default_factory=Recording)

    @field_validator("link")
    @classmethod
    def _frames_fit_the_link(cls, link: LinkTarget, info: ValidationInfo) -> LinkTarget:
        plate = info.data.get("plate")
        if plate and isinstance(link, SerialLink):
            _check_load(plate, link.baud)
        return link

    @field_validator("decoding", mode="wrap")
    @classmethod
    def _method_suits_the_sites(
        cls, raw: Any, handler: ModelWrapValidatorHandler[Decoding], info: ValidationInfo
    ) -> Decoding:
        method = raw.get("method") if isinstance(raw, dict) else None
        plate = info.data.get("plate")
        findings = []
        if method == "fourier" and plate and plate.skin and not plate.grid:
            sentence = f'needs a [grid], plate {plate.name!r} has scattered sites; use "open-plane"'
            findings.append(finding(("method",), method, sentence))
        return check_with(findings, handler, raw)

    @field_validator("measurement", mode="wrap")
    @classmethod
    def _whole_frames(
        cls, raw: Any, handler: ModelWrapValidatorHandler[Measurement], info: ValidationInfo
    ) -> Measurement:
        table = raw if isinstance(raw, dict) else {}
        return check_with(_timing_findings(table, info.data.get("plate")), handler, raw)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what was asked for and has no effect, or has had its time."""
        notes = [self.plate.calibration.expiry_note(datetime.now(UTC).date())]
        if self.decoding.method == "fourier" and self.decoding.contact_physics and self.plate.skin is not None:
            notes.append(
                'decoding.contact_physics = true has no effect with method = "fourier": it rests on "open-plane"; '
                "tractions are those of the linear map"
            )
        return (*filter(None, notes), *self.mqtt.notes)


def load_config(path: Path) -> Config:
    """Load a configuration and the plate file it names.

    Raises
    ------
    ConfigError
        One message for each finding, those of the plate file among them.
    """
    return load_model(Config, read_toml(path), context=path.parent)


class Client(Table):
    """What those need to know who watch or ask daemons: the broker, and which daemon, by its name or its link."""

    name: Annotated[str, Field(max_length=100), AfterValidator(plate_name)] | None = None
    link: Annotated[LinkTarget, PlainValidator(parse_link)] | None = None
    mqtt: Mqtt = Mqtt()


def load_client(path: Path) -> Client:
    """Load what a client needs of a configuration: of the daemon's, or of a file of its own.

    Raises
    ------
    ConfigError
        One message for each finding.
    """
    file = read_toml(path)
    of_the_daemon = Config.model_fields.keys() - Client.model_fields.keys()
    content = {key: value for key, value in file.content.items() if key not in of_the_daemon}
    return load_model(Client, replace(file, content=content), context=path.parent)


def example_config() -> str:
    """Return a configuration that passes `load_config`, with a comment on each key that needs one."""
    return _EXAMPLE


def frame_bytes(plate: Plate) -> int:
    """Return the size of one frame on the wire, packets' overhead included (PROTOCOL.md, sections 6 and 7)."""
    if plate.counter.kind == "single-tone":
        return PACKET_OVERHEAD_BYTES + CHANNEL_COUNT * SINGLE_TONE_STRUCT.size
    tones = len(plate.tones.f0_hz)
    parts = math.ceil(tones / ((MAX_PAYLOAD_BYTES - BLOCK_STRUCT.size) // TONE_STRUCT.size))
    return CHANNEL_COUNT * (parts * (PACKET_OVERHEAD_BYTES + BLOCK_STRUCT.size) + tones * TONE_STRUCT.size)


def _check_load(plate: Plate, baud: int) -> None:
    size = frame_bytes(plate)
    rate_hz = plate.counter.frame_rate_hz
    load = size * _BITS_PER_BYTE * rate_hz
    if load >= baud:  # status messages need some of it, too
        fits_hz = (baud - 1) // (size * _BITS_PER_BYTE)
        raise ValueError(
            f"{rate_hz:g} frames/s of {size} bytes are {load:.0f} bit/s ({_BITS_PER_BYTE} bits a byte) and need more "
            f"than {baud} baud; raise baud above {load:.0f}, or lower counter.frame_rate_hz of plate {plate.name!r}: "
            f"the highest that fits is {fits_hz} Hz"
        )


def timing_problems(spans_ms: Mapping[str, float], plate: Plate | None) -> list[tuple[str, float, str]]:
    """Return key, value and what is wrong of `window_ms` and `step_ms`, against each other and the plate's frames.

    A span that is not given is not looked at, nor is the plate.
    """
    problems = []
    if len(spans_ms) == 2 and spans_ms["step_ms"] > spans_ms["window_ms"]:
        sentence = f"must be at most window_ms = {spans_ms['window_ms']:g}, or counts would be lost between windows"
        problems.append(("step_ms", spans_ms["step_ms"], sentence))
    if plate and plate.skin is None:
        period_ms = 1e3 / plate.counter.frame_rate_hz
        for key, value in spans_ms.items():
            frames = value / period_ms
            if abs(frames - round(frames)) > 1e-6 * frames or round(frames) == 0:
                below = max(1, math.floor(frames))
                sentence = (
                    f"must be a whole number of frame periods of {period_ms:g} ms ({plate.counter.frame_rate_hz:g} "
                    f"frames/s of plate {plate.name!r}); near: {below * period_ms:g} or {(below + 1) * period_ms:g}"
                )
                problems.append((key, value, sentence))
    return problems


def _timing_findings(table: dict[str, Any], plate: Plate | None) -> list[InitErrorDetails]:
    spans_ms = {key: table.get(key, getattr(Measurement(), key)) for key in ("window_ms", "step_ms")}
    spans_ms = {key: value for key, value in spans_ms.items() if type(value) in (int, float) and 0 < value <= 1000}
    return [finding((key,), value, sentence) for key, value, sentence in timing_problems(spans_ms, plate)]
