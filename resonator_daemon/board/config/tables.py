"""Tables of a configuration file: commands, recording, metrics, measurement, decoding."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainValidator,
    StrictBool,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
)

from resonator_daemon.base.host.files import state_directory
from resonator_daemon.base.toml import Number, Table, split_url
from resonator_daemon.board.config.mqtt import is_this_computer, topic_level

DECODER = "decoder"  # level of the topics of decoder processes, which no plate can have as a name


def plate_name(text: str) -> str:
    """Return the text if plates can publish under it; raise ValueError otherwise."""
    if text == DECODER:
        raise ValueError("is the topic of decoder processes; choose another")
    if text in (".", ".."):
        raise ValueError("becomes a directory of its own; choose another")
    return topic_level(text)


def _directory(value: object, info: ValidationInfo) -> Path:
    if not isinstance(value, str) or not value or "\0" in value:
        raise ValueError("must be a string: a directory, relative to this file or absolute")
    return (info.context or Path()) / value


_FRICTION_LIMITS: Final = (0.001, 10)


def _friction(value: object) -> object:
    if value == "unknown":
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        low, high = _FRICTION_LIMITS
        raise ValueError(f"must be 'unknown' or a number from {low:g} to {high:g}")
    return value


ChangingVerb = Literal["tare", "start_recording", "stop_recording", "mark", "set_window", "identify"]


class Commands(Table):
    """Commands that subscribers may send; `ping` and `events` change nothing and are always allowed."""

    allow: tuple[ChangingVerb, ...] = Field(
        default=(),
        description="permitted commands, in addition to those that change nothing",
        examples=[["tare", "mark"]],
    )


class Recording(Table):
    """Directory, start and size limits of this daemon's recordings."""

    directory: Annotated[Path, BeforeValidator(_directory)] = Field(
        default_factory=lambda: state_directory() / "recordings",
        description="directory of recordings, relative to this file or absolute; default: recordings/ in the daemon's "
        "state directory",
        examples=["/var/lib/resonatord/recordings"],
    )
    autostart: StrictBool = Field(
        default=False, description="record from the start of the daemon on, without a command"
    )
    include_messages: StrictBool = Field(
        default=False,
        description="also record the published messages: forces, contacts, decoded and states, as JSON channels",
    )
    file_max_mb: Annotated[Number, Field(ge=1, le=1e6)] = Field(
        default=1000.0, description="begin a new file after this size, in 10^6 bytes"
    )
    file_max_minutes: Annotated[Number, Field(ge=0.001, le=1e6)] = Field(
        default=60.0, description="begin a new file after this time"
    )
    max_total_mb: Annotated[Number, Field(ge=1, le=1e9)] = Field(
        default=10_000.0,
        validate_default=True,
        description="largest size of all recordings of this daemon's name; the oldest are removed and counted",
    )
    min_free_mb: Annotated[Number, Field(ge=0, le=1e9)] = Field(
        default=500.0,
        description="with less free disk space than this, recording stops until there is space again",
    )

    @field_validator("max_total_mb")
    @classmethod
    def _holds_a_file(cls, max_total_mb: float, info: ValidationInfo) -> float:
        file_max_mb = info.data.get("file_max_mb", 0.0)
        if max_total_mb < file_max_mb:
            raise ValueError(f"must be at least file_max_mb = {file_max_mb:g}; raise it, or lower file_max_mb")
        return max_total_mb


@dataclass(frozen=True)
class Listen:
    """An address of this computer to listen on."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """True if only programs of this computer can connect."""
        return is_this_computer(self.host)


def parse_listen(value: object) -> Listen:
    """Return the address that a text names; ValueError where it names none."""
    if isinstance(value, str) and "://" not in value and "@" not in value:
        with suppress(ValueError):  # reported below, with the allowed values
            url = split_url(f"//{value}")
            if url.hostname and url.port and not url.path and not url.query and not url.fragment:
                return Listen(url.hostname, url.port)
    raise ValueError('must be "ADDRESS:PORT" with a port from 1 to 65535, as "127.0.0.1:9464" or "[::1]:9464"')


class Metrics(Table):
    """Metrics of the daemon for Prometheus."""

    listen: Annotated[Listen, PlainValidator(parse_listen), WithJsonSchema({"type": "string"})] | None = Field(
        default=None,
        description="address and port of the Prometheus metrics; default: off",
        examples=["127.0.0.1:9464"],
    )

    @property
    def notes(self) -> tuple[str, ...]:
        if self.listen is None or self.listen.loopback:
            return ()
        return (
            f"metrics.listen: every client that reaches {self.listen} over the network can read the daemon's figures "
            "without a password; 127.0.0.1 is for this computer alone",
        )


class Measurement(Table):
    """Length of the window and publishing interval of forces; plates with a skin have neither."""

    window_ms: Annotated[Number, Field(gt=0, le=1000)] = Field(
        default=10.0, description="length of the window of one force; whole frame periods of the plate"
    )
    step_ms: Annotated[Number, Field(gt=0, le=1000)] = Field(
        default=5.0, description="time between published forces and contacts; whole frame periods, at most window_ms"
    )

    @property
    def window_s(self) -> float:
        return self.window_ms * 1e-3

    @property
    def step_s(self) -> float:
        return self.step_ms * 1e-3


class Decoding(Table):
    """Decoding of signals under a skin; unused for plates of force sites."""

    method: Literal["open-plane", "fourier", "off"] = Field(
        default="open-plane",
        description="the decoder; `fourier` is for plates with a [grid], `off` publishes signals only",
    )
    contact_physics: StrictBool = Field(
        default=True,
        description="constrain tractions by pressure, friction and absence of adhesion; with `open-plane` only",
    )
    friction_coefficient: Annotated[
        Annotated[Number, Field(ge=_FRICTION_LIMITS[0], le=_FRICTION_LIMITS[1])] | None,
        BeforeValidator(_friction),
        WithJsonSchema(
            {
                "anyOf": [
                    {"const": "unknown"},
                    {"type": "number", "minimum": _FRICTION_LIMITS[0], "maximum": _FRICTION_LIMITS[1]},
                ]
            }
        ),
    ] = Field(
        default=None,
        description="friction coefficient between the skin and the touching objects; default: unknown",
        examples=["unknown", 0.5],
    )
    uncertainty: StrictBool = Field(
        default=True, description="publish the standard deviation of the traction in `decoded`"
    )
    displacement: StrictBool = Field(default=True, description="publish the displacement of the surface in `decoded`")
    external: StrictBool = Field(
        default=False, description="publish signals only; `resonatord decode` decodes them in a process of its own"
    )
    plates: tuple[Annotated[str, Field(max_length=100), AfterValidator(plate_name)], ...] = Field(
        default=(),
        description="plates that one `resonatord decode` follows; default: `name`",
        examples=[["left-index", "left-thumb"]],
    )
    group: Annotated[str, AfterValidator(topic_level)] | None = Field(
        default=None,
        description="decoders of one group share the plates: one of them receives each frame",
        examples=["touch"],
    )
