"""docs/long-life.md names tests that are there."""

import re
from pathlib import Path

PAGE = Path(__file__).parent.parent / "docs" / "long-life.md"
NAMED = re.compile(r"`((?:\w+/)*test_\w+\.py)`")


def test_every_test_that_the_page_names_is_there() -> None:
    named = set(NAMED.findall(PAGE.read_text(encoding="utf-8")))
    assert len(named) > 10
    assert [name for name in sorted(named) if not (Path(__file__).parent / name).is_file()] == []


def test_every_test_of_a_long_life_is_on_the_page() -> None:
    named = set(NAMED.findall(PAGE.read_text(encoding="utf-8")))
    here = {path.name for path in Path(__file__).parent.glob("test_long_life_*.py")} - {Path(__file__).name}
    assert here <= named
