"""Former place of the entry point, for environments that were set up before `resonator_daemon.commands`."""

from resonator_daemon.commands import main

__all__ = ["main"]
