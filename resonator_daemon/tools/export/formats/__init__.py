"""Formats of `resonatord export`: one file for each, with its name.

Each file has a class `Format`, a subclass of `exporting.output.Output`. A file is imported when its format is chosen,
because it needs libraries that the others can do without.
"""

import importlib
import pkgutil
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from resonator_daemon.tools.export.output import Output

FORMATS: Final = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))
ROS2: Final = "ros2"  # the only one whose files do not end in its name


def format_class(form: str) -> "type[Output]":
    """Return the class that writes a format."""
    found: type[Output] = importlib.import_module(f"{__name__}.{form}").Format
    return found
