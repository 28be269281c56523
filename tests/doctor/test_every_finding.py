"""Each finding that the doctor can make has a test that injects what it is about, and a line in its page."""

import importlib
import pkgutil
import re
from pathlib import Path

from resonator_daemon import doctor
from resonator_daemon.doctor.finding import Check

PAGE = Path(__file__).parents[2] / "docs" / "doctor.md"


def known_ids() -> set[str]:
    modules = (
        importlib.import_module(f"{doctor.__name__}.{found.name}") for found in pkgutil.iter_modules(doctor.__path__)
    )
    return {value.id for module in modules for value in vars(module).values() if isinstance(value, Check)}


def test_each_finding_is_in_the_page() -> None:
    assert known_ids() <= set(re.findall(r"`([a-z]+\.[a-z_]+)`", PAGE.read_text()))
