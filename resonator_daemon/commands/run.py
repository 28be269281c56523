"""Measure one board and publish its forces and contacts over MQTT, until stopped.

A second `run` of the same file fails.

Example: resonatord run left-index.toml
"""

import argparse

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.tools.command_line import add_config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "the configuration; see: resonatord config example")


def run(arguments: argparse.Namespace) -> ExitCode:
    import asyncio
    import signal

    from resonator_daemon.base.host.files import state_directory
    from resonator_daemon.daemon.service.config_store import ConfigStore
    from resonator_daemon.daemon.service.daemon import serve

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # also after it is handled: a reload never ends the process
    try:
        asyncio.run(serve(ConfigStore(arguments.config, state_directory() / "last-good")))
    except BaseException:
        signal.signal(signal.SIGHUP, before)
        raise
    return ExitCode.DONE
