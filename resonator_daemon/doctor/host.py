"""The computer that is checked: its files below a root that a test may choose, and what this process may open."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


def _may_use(path: Path) -> bool:
    return os.access(path, os.R_OK | os.W_OK)


@dataclass(frozen=True)
class Host:
    """Where /sys, /proc, /etc and /run are, and whether a file may be read and written here."""

    root: Path = Path("/")
    may_use: Callable[[Path], bool] = _may_use

    def at(self, path: str | Path) -> Path:
        """Return where an absolute path of the computer is."""
        return self.root / str(path).lstrip("/")

    def text(self, path: str | Path) -> str | None:
        """Return a small file's content without white space around it; None where there is none to be read."""
        try:
            return self.at(path).read_text(errors="replace").strip()
        except OSError:
            return None

    def running(self, name: str) -> bool:
        """Whether a process of this name runs."""
        return any(self.text(f"/proc/{directory.name}/comm") == name for directory in self.at("/proc").glob("[0-9]*"))
