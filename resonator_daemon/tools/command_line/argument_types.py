"""Types of arguments that several commands share, and options made of arguments."""

import argparse
import dataclasses
import math
import os.path
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from resonator_daemon.base.errors import ConfigurationError, UsageError

T = TypeVar("T")


def number(low: float, high: float) -> Callable[[str], float]:
    """Return a parser of numbers from `low` to `high`."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number from {low:g} to {high:g}")
        return value

    return parse


def whole_number(low: int, high: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from `low` to `high`."""

    def parse(text: str) -> int:
        if not (text.isascii() and text.isdecimal() and len(text) < 19 and low <= int(text) <= high):
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high:g}")
        return int(text)

    return parse


def positive(text: str) -> float:
    """Parse a number above 0 and below 1e9."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0 and below 1e9")
    return value


def link_target(text: str) -> object:
    """Parse the address of a link, as serial:PATH?baud=N."""
    from resonator_daemon.board.links.carriers import parse_link

    try:
        return parse_link(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: {error}") from error


def add_config(parser: argparse.ArgumentParser, meaning: str) -> None:
    """Add the configuration file as an argument and, likewise, as `--config`; one of them has to be given."""
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument("--config", type=Path, metavar="FILE", help="the same as FILE")
    add_config_argument(group, meaning)


def add_config_argument(group: Any, meaning: str) -> None:
    """Add the configuration file as an argument to a group that has it as `--config`."""

    def path(text: str) -> Path | str:
        return text if text is argparse.SUPPRESS else Path(text)  # its default leaves --config as it is

    group.add_argument("config", type=path, nargs="?", default=argparse.SUPPRESS, metavar="FILE", help=meaning)


def link_or_config(text: str) -> object:
    """Parse the address of a link, or the name of a configuration file, which ends in .toml."""
    return Path(text) if text.endswith(".toml") else link_target(text)


def separate_config(arguments: argparse.Namespace) -> None:
    """Move the configuration file of `link_or_config` from `link` to `config`; UsageError where both are given."""
    if isinstance(arguments.link, Path):
        if arguments.config is not None:
            raise UsageError(f"{arguments.link} and --config {arguments.config}: give one configuration")
        arguments.config, arguments.link = arguments.link, None


def check_plate_name(name: str) -> None:
    """Raise UsageError where `--plate` names neither a shipped plate nor a file."""
    from resonator_daemon.base.plate import load_plate, shipped_plates

    try:
        if name not in shipped_plates() and not os.path.exists(name):
            load_plate(name)
    except ConfigurationError as error:
        raise UsageError(f"--plate: {error}") from error


def picture(text: str) -> Path:
    """Parse the name of a picture file."""
    path = Path(text)
    if path.suffix not in (".svg", ".png", ".pdf"):
        raise argparse.ArgumentTypeError(f"{text!r} must end in .svg, .png or .pdf")
    return path


def options_of(kind: Callable[..., T], arguments: argparse.Namespace, **others: Any) -> T:
    """Return a dataclass of options: the arguments with the names of its fields, and `others`.

    An argument that was not given, and has no default, leaves the field its own.
    """
    names = [field.name for field in dataclasses.fields(kind) if hasattr(arguments, field.name)]  # type: ignore[arg-type]
    return kind(**{name: getattr(arguments, name) for name in names} | others)


def host_and_port(text: str) -> tuple[str, int]:
    """Parse HOST:PORT, where port 0 selects a free one."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT (try 127.0.0.1:0; port 0 selects a free one)")
    return host.strip("[]"), int(port)
