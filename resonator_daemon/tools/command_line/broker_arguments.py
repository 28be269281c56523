"""Arguments that name a broker and the prefix of its topics, or the daemon of one plate."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from resonator_daemon.base.errors import UsageError
from resonator_daemon.tools.command_line.argument_types import add_config_argument

if TYPE_CHECKING:
    from resonator_daemon.board.config.clients import Client
    from resonator_daemon.board.config.mqtt import Mqtt


def add_broker(parser: argparse.ArgumentParser, *, config_is_argument: bool = False) -> None:
    """Add `--url`, `--config` and `--prefix`; with `config_is_argument` the file may stand alone, too."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--url", help="the broker (default: mqtt://127.0.0.1:1883)")
    where.add_argument("--config", type=Path, metavar="FILE", help="a configuration, whose [mqtt] names the broker")
    if config_is_argument:
        add_config_argument(where, "a configuration, whose [mqtt] names broker, prefix and credentials")
    parser.add_argument("--prefix", help="first level of the topics (default: that of the configuration, or resonator)")


def broker_of(arguments: argparse.Namespace) -> "Mqtt":
    """Return the broker that is meant; UserError where it cannot be used."""
    from resonator_daemon.board.config.clients import load_client
    from resonator_daemon.board.config.mqtt import Mqtt
    from resonator_daemon.tools.view.watch import broker_at

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
    from resonator_daemon.board.config.tables import plate_name

    name = arguments.name
    if name is None and arguments.config is None:
        raise UsageError("give NAME|FILE or --config")
    if name is not None and name.endswith(".toml"):
        if arguments.config is not None or arguments.url is not None:
            raise UsageError(f"{name} names the broker; leave --config and --url out")
        arguments.config, name = Path(name), None
    if name is None:
        return load_client(arguments.config).model_copy(update={"mqtt": broker_of(arguments)})
    try:
        name = plate_name(name)
    except ValueError as error:
        raise UsageError(f"NAME: got {name!r}; {error}") from None
    return Client.model_construct(name=name, link=None, mqtt=broker_of(arguments))
