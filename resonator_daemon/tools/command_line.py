"""What commands share, those of extensions too: types of arguments, the arguments for a broker, output."""

import argparse
import dataclasses
import io
import json
import math
import os.path
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from resonator_daemon.base.errors import (
    ConfigurationError,
    DifferenceError,
    ExitCode,
    NoRecordingError,
    UsageError,
    UserError,
)
from resonator_daemon.base.host.systemd import error_prefix
from resonator_daemon.base.host.text import coloured, printable

if TYPE_CHECKING:
    from resonator_daemon.board.config.clients import Client
    from resonator_daemon.board.config.mqtt import Mqtt

T = TypeVar("T")
_AGAIN_S: Final = 0.5


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


def add_link(parser: argparse.ArgumentParser, config_help: str) -> None:
    """Add the address of a link, or a configuration file, as an argument, and `--config`."""

    def link_or_config(text: str) -> object:
        return Path(text) if text.endswith(".toml") else link_target(text)

    parser.add_argument(
        "link",
        nargs="?",
        type=link_or_config,
        metavar="LINK|FILE",
        help="serial:PATH?baud=N, tcp://HOST:PORT or usb:VID:PID?serial=S; see: resonatord ports; or a "
        "configuration, as left-index.toml (default: the configuration's)",
    )
    parser.add_argument("--config", type=Path, metavar="FILE", help=config_help)


def separate_config(arguments: argparse.Namespace) -> None:
    """Move the configuration file of `add_link` from `link` to `config`; UsageError where both are given."""
    if isinstance(arguments.link, Path):
        if arguments.config is not None:
            raise UsageError(f"{arguments.link} and --config {arguments.config}: give one configuration")
        arguments.config, arguments.link = arguments.link, None


def add_recording_options(parser: argparse.ArgumentParser, start_help: str) -> None:
    """Add `--config`, `--from` and `--until` of a command that plays a recording; `start_help` is that of `--from`."""
    instead = "configuration to use instead of the plate and settings in the recording"
    parser.add_argument("--config", type=Path, metavar="FILE", help=instead)
    parser.add_argument("--from", dest="start", metavar="MARK|SECONDS", help=start_help)
    parser.add_argument("--until", dest="end", metavar="MARK|SECONDS", help="end there")


@contextmanager
def named_recordings() -> Iterator[None]:
    """Raise NoRecordingError where a file that the arguments name is no recording."""
    from resonator_daemon.board.links.link import LinkUnavailableError

    try:
        yield
    except LinkUnavailableError as error:
        raise NoRecordingError(str(error)) from error


def check_plate_name(name: str) -> None:
    """Raise UsageError where `--plate` names neither a shipped plate nor a file."""
    from resonator_daemon.base.plate import load_plate, shipped_plates

    try:
        if name not in shipped_plates() and not os.path.exists(name):
            load_plate(name)
    except ConfigurationError as error:
        raise UsageError(f"--plate: {error}") from error


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


def add_broker(parser: argparse.ArgumentParser, *, config_is_argument: bool = False) -> None:
    """Add `--url`, `--config` and `--prefix`; with `config_is_argument` the file may stand alone, too."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--url", help="the broker (default: mqtt://127.0.0.1:1883)")
    where.add_argument("--config", type=Path, metavar="FILE", help="a configuration, whose [mqtt] names the broker")
    if config_is_argument:
        add_config_argument(where, "a configuration, whose [mqtt] names broker, prefix and credentials")
    parser.add_argument("--prefix", help="first level of the topics (default: that of the configuration, or resonator)")


def broker_at(url: str, prefix: str, *, named_by: str = "--url") -> "Mqtt":
    """Return the broker of the command line's options; `named_by` is that of the address.

    Raises
    ------
    UsageError
        The address or the prefix cannot be used.
    """
    from pydantic import ValidationError

    from resonator_daemon.base.toml import shown
    from resonator_daemon.board.config.mqtt import Mqtt

    try:
        return Mqtt(url=url, prefix=prefix).with_name(named_by)
    except ValidationError as error:
        findings = [(f["loc"][0], shown(f["input"]), f["msg"].removeprefix("Value error, ")) for f in error.errors()]
        raise UsageError(*(f"--{key}: got {value}; {sentence}" for key, value, sentence in findings)) from None


def broker_of(arguments: argparse.Namespace) -> "Mqtt":
    """Return the broker that is meant; UserError where it cannot be used."""
    from resonator_daemon.board.config.clients import load_client
    from resonator_daemon.board.config.mqtt import Mqtt

    if arguments.config is None:
        return broker_at(arguments.url or Mqtt().url, arguments.prefix or Mqtt().prefix)
    broker = load_client(arguments.config).mqtt
    if arguments.prefix is None:
        return broker
    return broker.model_copy(update={"prefix": broker_at(Mqtt().url, arguments.prefix).prefix})


def add_daemon(parser: argparse.ArgumentParser, *, required: bool = True) -> None:
    """Add `NAME|FILE`, which names a daemon; unless `required`, `--config` of `add_broker` may name it instead."""
    parser.add_argument(
        "name",
        nargs=None if required else "?",
        metavar="NAME|FILE",
        help="that the daemon publishes under; or its configuration, as left-index.toml, which also names the broker",
    )


def client_of(arguments: argparse.Namespace) -> "Client":
    """Return name and broker of the daemon that `NAME|FILE` and the options of `add_broker` name.

    Raises
    ------
    UserError
        They name none, or contradict each other, or the configuration cannot be used.
    """
    from resonator_daemon.board.config.clients import Client, load_client

    name = arguments.name
    if name is None and arguments.config is None:
        raise UsageError("give NAME|FILE or --config")
    if name is not None and name.endswith(".toml"):
        if arguments.config is not None or arguments.url is not None:
            raise UsageError(f"{name} names the broker; leave --config and --url out")
        arguments.config, name = Path(name), None
    if name is None:
        return load_client(arguments.config).model_copy(update={"mqtt": broker_of(arguments)})
    name = checked_name(name, "NAME")
    return Client.model_construct(name=name, link=None, mqtt=broker_of(arguments))


def checked_name(name: str, named_by: str) -> str:
    """Return a name that plates can publish under; UsageError, which states `named_by`, where they cannot."""
    from resonator_daemon.board.config.tables import plate_name

    try:
        return plate_name(name)
    except ValueError as error:
        raise UsageError(f"{named_by}: {name!r} {error}") from None


def add_published_plate(parser: argparse.ArgumentParser) -> None:
    """Add `--plate`: the name that one plate is published under, instead of every plate."""
    meaning = "only this one, as it is published (default: every plate)"
    parser.add_argument("--plate", type=_published_name, metavar="NAME", help=meaning)


def _published_name(text: str) -> str:
    from resonator_daemon.board.config.tables import plate_name

    try:
        return plate_name(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"got {text!r}; {error}") from None


def add_listen(parser: argparse.ArgumentParser, port: int, meaning: str) -> None:
    """Add `--listen`, an address of this computer with this port unless it is given, and `--json` for its URL."""
    address = f"127.0.0.1:{port}"
    meaning = f"{meaning}; port 0 selects a free one (default: {address})"
    parser.add_argument("--listen", type=host_and_port, default=address, metavar="HOST:PORT", help=meaning)
    parser.add_argument("--json", action="store_true", help='print {"url": ...} on stdout when the server is ready')


def print_url(server: str, url: str, *, as_json: bool) -> None:
    """Print the address of a server that is ready, for programs or for people."""
    if as_json:
        print_json({"url": url})
    else:
        sys.stdout.write(f"{server}: {url}\nstop with Ctrl-C\n")
    sys.stdout.flush()


def print_json(value: object) -> None:
    """Print a value as one line of JSON."""
    sys.stdout.write(json.dumps(value) + "\n")


def finish(arguments: argparse.Namespace, result: Mapping[str, Any], problems: Sequence[str] = ()) -> ExitCode:
    """Print the result as JSON where that is wanted; raise DifferenceError with it where there are problems."""
    if problems:
        raise DifferenceError(*problems, partial_result=result)
    if arguments.json:
        print_json({"verb": arguments.command, "ok": True, **result})
    return ExitCode.DONE


def print_failure(command: str, error: UserError) -> None:
    """Print the JSON object of a command that failed: what there is of its result, and why."""
    why = {"code": error.code, "message": str(error), "hint": error.hint}  # a daemon's refusal has its own
    print_json({"verb": command, "ok": False, "error": why} | {**error.partial_result, "ok": False})


def print_page(page: Any, *, soft_wrap: bool = False) -> None:
    """Print a renderable of rich; characters that the terminal's encoding lacks become question marks."""
    from rich.console import Console

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    Console(highlight=False).print(page, soft_wrap=soft_wrap)


def print_error(*messages: str) -> None:
    """Print each message as one line to the standard error."""
    for message in messages:
        program = coloured("resonatord:", "red", sys.stderr)
        sys.stderr.write(f"{error_prefix()}{program} {printable(message)}\n")


async def send_command(
    client: "Client",
    verb: str,
    payload: Mapping[str, Any],
    *,
    wait_s: float = 0.0,
    on_wait: Callable[[Mapping[str, Any]], None] = lambda refusal: None,
) -> dict[str, Any]:
    """Send a command to the running daemon of a configuration; return its answer.

    Parameters
    ----------
    wait_s
        For which it is sent again, twice a second, while the daemon is not ready or the plate not untouched.
    on_wait
        Called with the first such refusal.

    Raises
    ------
    UserError
        There is no broker, no such daemon or no answer.
    """
    import asyncio

    from resonator_daemon.mqtt.requests import find_daemon, reach, request

    await reach(client.mqtt)
    name = await find_daemon(client)
    loop = asyncio.get_running_loop()
    until_s, waits = loop.time() + wait_s, False
    while True:
        answer = await request(client.mqtt, name, verb, dict(payload))
        if refusal_of(answer).get("code") not in ("not_ready", "not_untouched") or loop.time() >= until_s:
            return answer
        if not waits:
            waits = True
            on_wait(refusal_of(answer))
        await asyncio.sleep(_AGAIN_S)


def print_answer(answer: Mapping[str, Any], not_done: str, *, as_json: bool, only: str | None = None) -> ExitCode:
    """Print an answer, or its key `only`; raise a refusal with the words `not_done` before its reason."""
    from resonator_daemon.mqtt.requests import RefusedError

    if answer.get("ok") is not True:
        reasons = refusal_of(answer)
        parts = [str(reasons[key]) for key in ("message", "hint") if reasons.get(key)]
        message = f"{not_done}: {'; '.join(parts) or 'refused'}"
        kept = answer if reasons.keys() >= {"code", "message"} else {k: v for k, v in answer.items() if k != "error"}
        raise RefusedError(str(reasons.get("code", RefusedError.code)), message, partial_result=kept)
    if as_json:
        print_json(answer)
    elif only is not None:
        sys.stdout.write(f"{printable(answer.get(only, 'done'))}\n")
    else:
        shown = {key: value for key, value in answer.items() if key not in ("verb", "ok", "id")}
        lines = [f"{printable(key)}: {_as_text(value)}" for key, value in shown.items()]
        sys.stdout.writelines(f"{line}\n" for line in lines or ["done"])
    return ExitCode.DONE


def refusal_of(answer: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return code, message and hint of a refusal; nothing where the answer has none."""
    refusal = answer.get("error")
    return refusal if isinstance(refusal, dict) else {}


def _as_text(value: object) -> str:
    return printable(value) if isinstance(value, str) else json.dumps(value, indent=2)  # ASCII
