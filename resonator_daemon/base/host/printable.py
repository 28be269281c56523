"""Text for terminals: foreign text made safe, and lines for the terminal."""

import os
import shlex
import sys
from typing import Final, Literal, TextIO

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
