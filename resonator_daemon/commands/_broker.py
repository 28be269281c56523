"""Options that name a broker, and the prefix of its topics."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from resonator_daemon.commands._argument_types import add_config_argument

if TYPE_CHECKING:
    from resonator_daemon.config import Mqtt


def add_broker(parser: argparse.ArgumentParser, *, config_is_argument: bool = False) -> None:
    """Add `--url`, `--config` and `--prefix`; with `config_is_argument` the file may stand alone, too."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--url", help="the broker (default: mqtt://127.0.0.1:1883)")
    where.add_argument("--config", type=Path, metavar="FILE", help="whose [mqtt] names broker, prefix and credentials")
    if config_is_argument:
        add_config_argument(where, "the configuration, likewise")
    parser.add_argument("--prefix", help="first level of the topics (default: that of the configuration, or resonator)")


def broker_of(arguments: argparse.Namespace) -> "Mqtt":
    """Return the broker that is meant; UserError where it cannot be used."""
    from resonator_daemon.config import Mqtt, load_client
    from resonator_daemon.view.watch import broker_at

    if arguments.config is None:
        return broker_at(arguments.url or Mqtt().url, arguments.prefix or Mqtt().prefix)
    broker = load_client(arguments.config).mqtt
    if arguments.prefix is None:
        return broker
    return broker.model_copy(update={"prefix": broker_at(Mqtt().url, arguments.prefix).prefix})
