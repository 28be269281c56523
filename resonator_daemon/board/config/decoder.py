"""Configuration of a decoder process: a file of its own, or its part of the daemon's file."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from resonator_daemon.base.toml import Table, read_toml
from resonator_daemon.board.config.board import load_part
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.config.tables import Decoding, plate_name


class DecoderConfig(Table):
    """Whose signals to decode, how, and over which broker.

    The plate called `name` is followed, or those of `decoding.plates`; with `decoding.group`, their frames are shared.
    """

    mqtt: Mqtt = Mqtt()
    decoding: Annotated[Decoding, Field(validate_default=True)] = Decoding()
    name: Annotated[
        Annotated[str, Field(max_length=100), AfterValidator(plate_name)] | None, Field(validate_default=True)
    ] = None

    @field_validator("decoding")
    @classmethod
    def _decodes(cls, decoding: Decoding) -> Decoding:
        if decoding.method == "off":
            raise ValueError('method = "off" leaves a decoder nothing to do; use "open-plane" or "fourier"')
        return decoding

    @field_validator("name")
    @classmethod
    def _names_a_plate(cls, name: str | None, info: ValidationInfo) -> str | None:
        decoding = info.data.get("decoding")
        if name is None and decoding is not None and not decoding.plates:
            raise ValueError("missing; give the name of the plate, or decoding.plates")
        return name

    @property
    def method(self) -> Literal["open-plane", "fourier"]:
        return "fourier" if self.decoding.method == "fourier" else "open-plane"


def load_decoder_config(path: Path) -> DecoderConfig:
    """Load a decoder's configuration; keys of the daemon alone are ignored.

    Raises
    ------
    ConfigurationError
        One message for each finding.
    """
    return load_part(DecoderConfig, path)


def is_decoders_own(path: Path) -> bool:
    """Return whether a file is a decoder's alone: it has decoding keys, and neither plate nor link.

    Raises
    ------
    ConfigurationError
        It cannot be read.
    """
    keys = read_toml(path).content.keys()
    return "decoding" in keys and not keys & {"plate", "link"}
