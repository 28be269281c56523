"""Where the pages of the documentation are: in the checkout, or installed with the program."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

_INSTALLED: Final = Path("share", "doc", "resonatord")
_MENTION: Final = re.compile(r"(?<![\w/])docs/([\w-]+/[\w-]+\.md)\b")


def page(name: str) -> str:
    """Return the path of a page, as `how-to/connect.md`; its place in the sources if it is not installed."""
    found = (folder / name for folder in _folders() if (folder / name).is_file())
    return str(next(found, Path("docs", name)))


def with_pages(text: str) -> str:
    """Return a text in which each mention of a page, as `docs/how-to/connect.md`, is its path on this computer."""
    return _MENTION.sub(lambda found: page(found[1]), text)


def _folders() -> Iterator[Path]:
    root = Path(__file__).parents[3]
    yield from (root / "docs", root / _INSTALLED)  # a checkout, `pip install --target`
    import sysconfig  # slow to import

    for scheme in (sysconfig.get_default_scheme(), sysconfig.get_preferred_scheme("user")):
        yield Path(sysconfig.get_path("data", scheme)) / _INSTALLED
