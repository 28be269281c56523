"""Decode the signals of skins in a process of its own, anywhere on the network, until stopped.

Example: resonatord decode --config left-index.toml
"""

import argparse
from contextlib import suppress
from pathlib import Path

from resonator_daemon.errors import ExitCode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--config",
        type=Path,
        required=True,
        metavar="FILE",
        help="the daemon's, with `external = true` in [decoding], or one of [mqtt] and [decoding] alone",
    )


def run(arguments: argparse.Namespace) -> ExitCode:
    with suppress(KeyboardInterrupt):
        import asyncio

        from resonator_daemon.config.decoder import load_decoder_config
        from resonator_daemon.remote_decoding.service import serve

        asyncio.run(serve(load_decoder_config(arguments.config)))
    return ExitCode.DONE
