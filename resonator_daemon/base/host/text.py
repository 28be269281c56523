"""Text for people: paths of pages, foreign text made safe, lines for the terminal."""

import os
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Literal, TextIO

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


Colour = Literal["red", "green", "yellow"]
_COLOURS: Final[dict[Colour, int]] = {"red": 31, "green": 32, "yellow": 33}

# Of Debian's package, which has no pip of its own (.ci/make_deb.sh).
_DEBIAN_PREFIX: Final = "/usr/lib/resonatord"
_DEBIAN_EXTRAS: Final = "/usr/local/lib/resonatord"


def printable(text: object) -> str:
    """Return the text in one line, without control characters."""
    return "".join(sign if sign.isprintable() else "\N{REPLACEMENT CHARACTER}" for sign in str(text))


def coloured(text: str, colour: Colour, stream: TextIO) -> str:
    """Return the text in bold colour for a terminal (https://no-color.org), unchanged for other streams."""
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not stream.isatty()
    return text if plain else f"\x1b[1;{_COLOURS[colour]}m{text}\x1b[0m"


def how_to_install(package: str) -> str:
    """Return the command that installs a package for the Python that runs."""
    if sys.prefix == _DEBIAN_PREFIX:
        return f"sudo python3 -m pip install --target {_DEBIAN_EXTRAS} {package}"
    return f"{shlex.quote(sys.executable)} -m pip install {package}"


def print_note(text: str) -> None:
    """Print a line to the standard error."""
    sys.stderr.write(f"{printable(text)}\n")
    sys.stderr.flush()
