"""The carriers: the files of this package, each with one class of targets, and those of extensions."""

import pkgutil
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module

from resonator_daemon.base.entry_points import load_entries, load_entry
from resonator_daemon.base.toml import nearest
from resonator_daemon.board.links.target import LinkTarget


@cache
def own_carriers() -> Mapping[str, type[LinkTarget]]:
    """Return the targets of this package by the scheme that the text of a link begins with."""
    for module in pkgutil.iter_modules(__path__, f"{__name__}."):
        import_module(module.name)
    found = [target for target in LinkTarget.__subclasses__() if target.__module__.startswith(f"{__name__}.")]
    return {target.scheme: target for target in sorted(found, key=lambda target: target.scheme)}


def all_carriers() -> Iterator[type[LinkTarget]]:
    """Yield the targets of all carriers."""
    yield from own_carriers().values()
    yield from (carrier for _, carrier in load_entries("carriers", _is_carrier))


def _is_carrier(found: type) -> bool:
    return issubclass(found, LinkTarget)


def parse_link(text: object) -> LinkTarget:
    """Parse the text of a link, or pass a target through; the text of a ValueError is what it must be."""
    if isinstance(text, LinkTarget):
        return text
    if not isinstance(text, str):
        raise ValueError(f"must be a string: {link_forms()}")
    scheme = text.partition(":")[0]
    if (carrier := own_carriers().get(scheme) or load_entry("carriers", scheme, _is_carrier)) is not None:
        return carrier.parse(text)
    if text.startswith("/dev/"):
        raise ValueError("must name the kind of link and its rate, as serial:/dev/ttyACM0?baud=4000000")
    raise ValueError(f"no link is called {scheme!r}; {nearest(scheme, [carrier.scheme for carrier in all_carriers()])}")


def link_forms() -> str:
    """Return the forms of all links, for messages."""
    *forms, last = (carrier.syntax for carrier in own_carriers().values())
    return f"{', '.join(forms)} or {last}"
