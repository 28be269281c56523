"""Formats of `resonatord export`: one file for each, with its name, and those of extensions.

Each file has a class `Format`, a subclass of `export.output.Output`. A file is imported when its format is chosen,
because it needs libraries that the others can do without.
"""

import importlib
import pkgutil
from typing import TYPE_CHECKING, Final

from resonator_daemon.base.entry_points import entry_names, load_entry
from resonator_daemon.base.errors import UsageError

if TYPE_CHECKING:
    from resonator_daemon.tools.export.output import Output

_OWN: Final = frozenset(module.name for module in pkgutil.iter_modules(__path__))


def formats() -> list[str]:
    """Return the names of all formats."""
    return sorted(_OWN.union(entry_names("exports")))


def format_class(form: str) -> "type[Output]":
    """Return the class that writes a format; UsageError where that of an extension cannot be used."""
    found: type[Output] | None
    if form in _OWN:
        found = importlib.import_module(f"{__name__}.{form}").Format
    else:
        found = load_entry("exports", form, _is_format)
    if found is None:
        raise UsageError(f"the format {form} cannot be used; its extension is left out")
    return found


def _is_format(found: type) -> bool:
    from resonator_daemon.tools.export.output import Output

    return issubclass(found, Output)
