"""Extensions: what installed packages register as entry points in the groups `resonatord.<group>`."""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

from resonator_daemon.base.host.text import print_note

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


def entry_names(group: str) -> list[str]:
    """Return the names in a group; nothing is imported. The first call takes about 50 ms."""
    return sorted(_entries(group))


def load_entry(group: str, name: str, fits: Callable[[Any], bool]) -> Any:
    """Return what an entry names; None where there is no such entry, or with one warning where it cannot be used.

    Parameters
    ----------
    fits
        Returns whether an object has the interface of the group; an exception means no.
    """
    return _load(group, name, fits) if name in _entries(group) else None


def load_entries(group: str, fits: Callable[[Any], bool]) -> Iterator[tuple[str, Any]]:
    """Yield name and object of each entry that can be used."""
    for name in entry_names(group):
        if (loaded := load_entry(group, name, fits)) is not None:
            yield name, loaded


@cache
def _entries(group: str) -> "Mapping[str, EntryPoint]":
    from importlib.metadata import entry_points  # slow to import

    found = entry_points(group=f"resonatord.{group}")
    return {entry.name: entry for entry in reversed(list(found))}  # of two, the first on Python's path


@cache
def _load(group: str, name: str, fits: Callable[[Any], bool]) -> Any:
    try:
        loaded = _entries(group)[name].load()
        if not fits(loaded):
            raise TypeError(f"not what resonatord.{group} needs")
    except (Exception, SystemExit) as error:  # noqa: BLE001 - code of others, without which all else works
        print_note(f"warning: extension {name} is left out: {type(error).__name__}: {error}")
        return None
    return loaded
