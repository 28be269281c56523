"""Decode the signals of skins in a process of its own, anywhere on the network, until stopped.

Example: resonatord decode left-index.toml
"""

import argparse

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line import add_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    meaning = "the daemon's configuration, with `external = true` in [decoding], or one of [mqtt] and [decoding] alone"
    add_config(parser, meaning)


def run(arguments: argparse.Namespace) -> ExitCode:
    import asyncio

    from resonator_daemon.board.config.clients import load_decoder_config
    from resonator_daemon.extensions.remote_decoding.service import serve

    asyncio.run(serve(load_decoder_config(arguments.config)))
    return ExitCode.DONE
