"""Configuration of clients and decoder processes: a file of their own, or their part of the daemon's file."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, Field, PlainValidator, ValidationError, ValidationInfo, field_validator

from resonator_daemon.base.toml import Table, finding, load_model, read_toml
from resonator_daemon.board.config import Config, config_from
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.board.config.tables import Decoding, plate_name
from resonator_daemon.board.links.carriers import parse_link
from resonator_daemon.board.links.target import LinkTarget

_Part = TypeVar("_Part", bound=Table)


class Client(Table):
    """Configuration of a client: the broker, and the daemon by its name or its link."""

    name: Annotated[str, Field(max_length=100), AfterValidator(plate_name)] | None = None
    link: Annotated[LinkTarget, PlainValidator(parse_link)] | None = None
    mqtt: Mqtt = Mqtt()


def load_client(path: Path) -> Client:
    """Load a client's configuration from the daemon's file, which is checked as a whole, or from a file of its own.

    Raises
    ------
    ConfigurationError
        One message for each finding.
    """
    file = read_toml(path)
    if "plate" not in file.content:
        return load_part(Client, path)
    config = config_from(file, path.parent)
    return Client.model_construct(name=config.name, link=config.link, mqtt=config.mqtt)


def load_part(model: type[_Part], path: Path) -> _Part:
    """Load the keys of a model from a configuration file; keys of the daemon alone are ignored.

    Raises
    ------
    ConfigurationError
        One message for each finding.
    """
    file = read_toml(path)
    of_the_daemon = Config.model_fields.keys() - model.model_fields.keys()
    content = {key: value for key, value in file.content.items() if key not in of_the_daemon}
    return load_model(model, replace(file, content=content), context=path.parent)


class DecoderConfig(Table):
    """Whose signals to decode, how, and over which broker."""

    mqtt: Mqtt = Mqtt()
    decoding: Decoding = Decoding()
    name: Annotated[str, Field(max_length=100), AfterValidator(plate_name)] | None = Field(
        default=None, validate_default=True
    )

    @field_validator("decoding")
    @classmethod
    def _decodes(cls, decoding: Decoding) -> Decoding:
        if decoding.method == "off":
            off = finding(("method",), "off", 'leaves a decoder nothing to do; use "open-plane" or "fourier"')
            raise ValidationError.from_exception_data("decoding", [off])
        return decoding

    @field_validator("name")
    @classmethod
    def _names_a_plate(cls, name: str | None, info: ValidationInfo) -> str | None:
        if name is None and "decoding" in info.data and not info.data["decoding"].plates:
            raise ValueError("missing; give the name of the plate, or decoding.plates")
        return name

    @property
    def plates(self) -> tuple[str, ...]:
        """Return the names of the plates to decode, each once."""
        return tuple(dict.fromkeys(self.decoding.plates)) or ((self.name,) if self.name is not None else ())

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
