"""Stop the services, and remove the files that `resonatord install` installed.

A file that was changed here is kept. Configurations, recordings, states and the user stay.

Example: resonatord uninstall --dry-run
"""

from resonator_daemon.commands.install import add_arguments, run

__all__ = ["add_arguments", "run"]
