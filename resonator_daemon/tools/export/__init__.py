"""A recording as files of other formats: the messages that follow from it, for programs without MQTT.

Formats are subclasses of `export.output.Output`: those of this package, and those of extensions. Each is imported when
it is chosen, because it needs libraries that the others can do without.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

from resonator_daemon.base.entry_points import entry_names, load_entry
from resonator_daemon.base.errors import UsageError

if TYPE_CHECKING:
    from resonator_daemon.tools.export.output import Output

_OWN: Final = {"csv": ("table_formats", "CsvFormat"), "parquet": ("parquet", "ParquetFormat")}


def formats() -> list[str]:
    """Return the names of all formats."""
    return sorted({*_OWN, *entry_names("exports")})


def format_class(form: str) -> "type[Output]":
    """Return the class that writes a format; UsageError where that of an extension cannot be used."""
    if form in _OWN:
        module, name = _OWN[form]
        own: type[Output] = getattr(import_module(f"{__name__}.{module}"), name)
        return own
    found: type[Output] | None = load_entry("exports", form, _is_format)
    if found is None:
        raise UsageError(f"the format {form} cannot be used; its extension is left out")
    return found


def _is_format(found: type) -> bool:
    from resonator_daemon.tools.export.output import Output

    return issubclass(found, Output)
