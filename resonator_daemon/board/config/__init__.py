"""Configuration file of one board, checked together with its plate file; all findings are reported at once."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    Field,
    ModelWrapValidatorHandler,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
)
from pydantic_core import InitErrorDetails

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate import Plate, load_plate
from resonator_daemon.base.toml import Table, TomlFile, check_with, finding, load_model, parse_toml, read_toml
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.config.tables import Commands, Decoding, Measurement, Metrics, Recording, plate_name
from resonator_daemon.board.links.carriers import link_forms, parse_link
from resonator_daemon.board.links.target import LinkTarget

_BITS_PER_BYTE = 10  # on a serial line: start bit, 8 data bits, stop bit


def _plate(value: object, info: ValidationInfo) -> Plate:
    """Load the plate that a configuration names, relative to the configuration's directory."""
    if isinstance(value, Plate):
        return value
    if not isinstance(value, str):
        raise ValueError("must be a string: the name of a shipped plate or a path")
    try:
        return load_plate(value, relative_to=info.context)
    except ConfigurationError as error:
        findings = [finding((), value, message) for message in error.messages]
        raise ValidationError.from_exception_data("plate", findings) from None


class Config(Table):
    """Configuration of one board: plate, link, measurement, decoding, publishing."""

    name: Annotated[str, Field(max_length=100), AfterValidator(plate_name)] | None = Field(
        default=None,
        description="name for publishing; default: the board's serial number",
        examples=["left-index"],
    )
    plate: Annotated[Plate, PlainValidator(_plate), WithJsonSchema({"type": "string"})] = Field(
        description="name of a shipped plate, or path of a plate file, relative to this file",
        examples=["quartz16", "left-index-plate.toml"],
    )
    link: Annotated[LinkTarget, PlainValidator(parse_link), WithJsonSchema({"type": "string"})] = Field(
        description=f"the board, or a recording of one: {link_forms()}; `resonatord ports` lists them",
        examples=["serial:/dev/serial/by-id/usb-RD_board_0042-if00?baud=4000000", "tcp://192.168.0.42:7000"],
    )
    mqtt: Mqtt = Field(default=Mqtt(), description="broker, authentication, and topic prefix")
    measurement: Measurement = Field(
        default=Measurement(),
        validate_default=True,
        description="how long to count for one force, and how often to publish one",
    )
    decoding: Decoding = Field(default=Decoding(), description="how signals under a skin are taken back to its surface")
    commands: Commands = Field(default=Commands(), description="what subscribers may have the daemon do")
    recording: Recording = Field(
        default_factory=Recording, description="directory, start and size limits of recordings"
    )
    metrics: Metrics = Field(default=Metrics(), description="figures of the daemon for Prometheus")

    @field_validator("link")
    @classmethod
    def _link_can_serve(cls, link: LinkTarget, info: ValidationInfo) -> LinkTarget:
        of_a_file = info.context is not None  # not of a recording that is open
        if of_a_file and link.recording_path is not None and not os.path.exists(link.recording_path):
            raise ValueError("no such file; name a recording, as a path from where the daemon is started")
        plate = info.data.get("plate")
        if plate and link.bits_per_s is not None:
            _check_load(plate, link.bits_per_s)
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
        table = dict(raw) if isinstance(raw, dict | Measurement) else {}
        return check_with(_timing_findings(table, info.data.get("plate")), handler, raw)

    @property
    def notes(self) -> tuple[str, ...]:
        """Warnings about keys without effect and keys that are obsolete."""
        notes = [self.plate.calibration.expiry_note(datetime.now(UTC).date())]
        if self.plate.skin is not None:
            notes.append(self.plate.skin.exact_note)
        if self.decoding.method == "fourier" and self.decoding.contact_physics and self.plate.decodable:
            notes.append(
                'decoding.contact_physics = true has no effect with method = "fourier": it rests on "open-plane"; '
                "tractions are those of the linear map"
            )
        if self.recording.autostart and self.link.recording_path is not None:
            notes.append("recording.autostart = true has no effect: link is a recording already")
        return (*filter(None, notes), *self.mqtt.notes, *self.metrics.notes)


def load_config(path: Path) -> Config:
    """Load a configuration and the plate file it names.

    Raises
    ------
    ConfigurationError
        One message for each finding, those of the plate file among them.
    """
    return config_from(read_toml(path), path.parent)


def config_from(file: TomlFile, directory: Path) -> Config:
    """Check the content of a file; paths in it are relative to the directory.

    Raises
    ------
    ConfigurationError
        One message for each finding.
    """
    return load_model(Config, file, context=directory)


def example_config(given: Mapping[str, str] | None = None) -> str:
    """Return a configuration that passes `load_config`, with a comment on each key that needs one.

    `given` has values of plate, link, name and url, whose comments are left out; ConfigurationError if unusable.
    """
    if given and "link" not in given:
        given = {**given, "link": "tcp://192.168.0.42:7000"}  # which suits every plate
    text = Path(__file__).with_name("example.toml").read_text(encoding="utf-8")
    for key, value in (given or {}).items():
        line = f"{key} = {json.dumps(value, ensure_ascii=False)}"
        text = re.sub(f"(?m)^{key} = .*$", line.replace("\\", r"\\"), text)
    if given:
        config_from(parse_toml(text, Path("example.toml")), Path.cwd())
    return text


def _check_load(plate: Plate, baud: int) -> None:
    size = plate.frame_bytes
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
    """Return key, value and fault of `window_ms` and `step_ms`, checked against each other and the frame rate.

    A span that is not given is not looked at, nor is the plate.
    """
    problems = []
    if len(spans_ms) == 2 and spans_ms["step_ms"] > spans_ms["window_ms"]:
        sentence = f"must be at most window_ms = {spans_ms['window_ms']:g}, or counts would be lost between windows"
        problems.append(("step_ms", spans_ms["step_ms"], sentence))
    if plate and not plate.decodable:  # a skin has readings of single frames
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
