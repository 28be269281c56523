"""Text for terminals: foreign text made safe, and lines for the terminal."""

import shlex
import sys


def printable(text: object) -> str:
    """Return the text in one line, without control characters."""
    return "".join(sign if sign.isprintable() else "\N{REPLACEMENT CHARACTER}" for sign in str(text))


def how_to_install(package: str) -> str:
    """Return the command that installs a package for the Python that runs."""
    return f"{shlex.quote(sys.executable)} -m pip install {package}"


def print_note(text: str) -> None:
    """Print a line to the standard error."""
    sys.stderr.write(f"{printable(text)}\n")
    sys.stderr.flush()
