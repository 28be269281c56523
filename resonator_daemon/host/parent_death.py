"""A signal to a process when the process that started it has ended, however that ended (`prctl` of Linux)."""

import ctypes
import os
from collections.abc import Callable

_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def signal_at_parent_death(number: int) -> None:
    """Let the kernel send this signal when the thread that started this process ends.

    A program that changes its user, as a server that drops root, is no longer sent the signal.
    """
    _LIBC.prctl(_PR_SET_PDEATHSIG, number)


def ended_with_parent(number: int) -> Callable[[], None]:
    """Return a function for a child to call between fork and exec: it ends with this process, by the signal."""
    parent = os.getpid()

    def prepare() -> None:
        signal_at_parent_death(number)
        if os.getppid() != parent:  # it has ended already
            os.kill(os.getpid(), number)

    return prepare
