"""`resonatord` with its arguments, which tells on SIGUSR1 what memory is in use: what an allocator keeps is no leak.

With the signal it writes a file of JSON, which the environment names.
"""

import ctypes
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Final, NamedTuple

FILE_VARIABLE: Final = "MEMORY_IN_USE_FILE"
_MB: Final = 2**20
_LOOK_S: Final = 0.01


class InUse(NamedTuple):
    """Memory in use: malloc's, and the blocks of up to 512 bytes that Python divides itself and malloc does not see."""

    malloc_mb: float
    python_blocks: int


class _Mallinfo2(ctypes.Structure):
    _names = ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    _fields_ = tuple((name, ctypes.c_size_t) for name in _names)


def in_use() -> InUse:
    """Return what this process uses now."""
    libc = ctypes.CDLL(None)
    libc.mallinfo2.restype = _Mallinfo2
    info = libc.mallinfo2()
    return InUse((info.uordblks + info.hblkhd) / _MB, sys.getallocatedblocks())


def ask_in_use(pid: int, path: Path, timeout_s: float) -> InUse | None:
    """Return what a watched daemon uses that writes to `path` and has begun to serve; None where it does not say."""
    path.unlink(missing_ok=True)
    until_s = time.monotonic() + timeout_s
    try:
        os.kill(pid, signal.SIGUSR1)
    except ProcessLookupError:
        return None
    while time.monotonic() < until_s:
        if path.exists():
            return InUse(**json.loads(path.read_text()))
        time.sleep(_LOOK_S)
    return None


def _tell(*_: object) -> None:
    path = Path(os.environ[FILE_VARIABLE])
    fresh = path.with_suffix(".fresh")
    fresh.write_text(json.dumps(in_use()._asdict()))
    fresh.replace(path)


def main() -> int:
    signal.signal(signal.SIGUSR1, _tell)
    from resonator_daemon.commands import main as resonatord

    return resonatord()


if __name__ == "__main__":
    sys.exit(main())
