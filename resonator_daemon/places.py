"""Where files of a running daemon live."""

import os
from pathlib import Path


def state_directory() -> Path:
    """Return where what must outlive a run is kept: systemd's choice, else the XDG Base Directory Specification's."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path(os.path.expanduser("~/.local/state"))) / "resonatord"
