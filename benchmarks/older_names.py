"""Present names for an older checkout, so that workers of `stage_cost.py` run with its Python and its modules."""

import importlib
import sys
from operator import attrgetter
from types import ModuleType
from typing import Final

# Module and name as they are, and as they were in checkouts that have no such module or name.
OLDER: Final = {
    ("resonator_daemon.arrays", "Floats"): ("resonator_daemon.decoding.skin", "Floats"),
    ("resonator_daemon.decoding.skin", "DecodingOptions"): ("resonator_daemon.decoding.skin", "Wanted"),
    ("resonator_daemon.replay.source", "open_replay"): ("resonator_daemon.playback.source", "open_playback"),
    ("resonator_daemon.replay.case", "replay_whole"): ("resonator_daemon.playback.case", "play_whole"),
    ("resonator_daemon.playback.course", "Playback.counters"): (
        "resonator_daemon.playback.course",
        "Playback.account",
    ),
}


def provide() -> None:
    """Add the present names that the checkout does not have."""
    for (module_name, name), (older_module, older_name) in OLDER.items():
        try:
            older = attrgetter(older_name)(importlib.import_module(older_module))
        except (ModuleNotFoundError, AttributeError):
            continue  # it is not that old
        owner, _, attribute = name.rpartition(".")
        module = _module(module_name)
        holder = attrgetter(owner)(module) if owner else module
        if not hasattr(holder, attribute):
            setattr(holder, attribute, older)


def _module(name: str) -> ModuleType:
    """Return the module, an empty one where the checkout has none."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        parent, _, last = name.rpartition(".")
        module = ModuleType(name)
        setattr(_module(parent), last, module)
        sys.modules[name] = module
        return module
