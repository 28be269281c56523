"""Signals that end a process: sent by the user, by the service manager, and by the kernel when the parent has ended."""

import ctypes
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from resonator_daemon.base.errors import InterruptedCommandError

_Handler = Callable[[int, FrameType | None], object] | int | None

_ENDING: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_IMPORT_FILE: Final = "<frozen importlib._bootstrap>"  # of a frame on the stack while a module is imported
_RETRY_S: Final = 0.02
_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


@contextmanager
def on_signals(call: Callable[[signal.Signals], object]) -> Iterator[None]:
    """Call a function on the running event loop upon SIGINT, SIGTERM or SIGHUP; restore the former handlers at the end.

    `loop.remove_signal_handler` would restore Python's defaults instead, which end the process with other exit codes.
    """
    from asyncio import get_running_loop  # slow to import; the decoder process needs other functions of this module

    if not _may_have_handlers():
        yield
        return
    loop = get_running_loop()
    reading, writing = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    loop.add_reader(reading, os.read, reading, 4096)
    wakes = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)  # wakes a loop that is about to wait
    before = {
        number: signal.signal(number, lambda it, _: loop.call_soon_threadsafe(call, signal.Signals(it)))
        for number in _ENDING
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakes)
        loop.remove_reader(reading)
        os.close(reading)
        os.close(writing)


@contextmanager
def interruptible(unfinished: str) -> Iterator[None]:
    """Turn SIGINT, SIGTERM and SIGHUP into one exception, so that the command cleans up as after any error.

    The first signal raises KeyboardInterrupt; later ones are ignored, so that the clean-up is completed. While a module
    is imported, where the exception can be lost, the signal is repeated after 20 ms. Ignored signals, as SIGHUP under
    nohup, remain ignored.

    Parameters
    ----------
    unfinished
        State of the unfinished output, as "nothing is written".

    Raises
    ------
    InterruptedCommandError
        A signal arrived.
    """
    before: dict[int, _Handler] = {}

    def end(number: int, frame: FrameType | None) -> None:
        while frame is not None:
            if frame.f_code.co_filename == _IMPORT_FILE:
                threading.Timer(_RETRY_S, os.kill, (os.getpid(), number)).start()
                return
            frame = frame.f_back
        for caught in before:
            signal.signal(caught, signal.SIG_IGN)
        raise KeyboardInterrupt

    try:
        if _may_have_handlers():
            for number in _ENDING:
                if (handler := signal.getsignal(number)) is not signal.SIG_IGN:
                    before[number] = handler
                    signal.signal(number, end)
        yield
    except KeyboardInterrupt as error:
        raise InterruptedCommandError(f"interrupted: {unfinished}") from error
    finally:
        for caught, handler in before.items():
            signal.signal(caught, handler)


def _may_have_handlers() -> bool:
    return threading.current_thread() is threading.main_thread()


def signal_at_parent_death(number: int) -> None:
    """Let the kernel send this signal when the thread that started this process ends.

    A program that changes its user, as a server that drops root, is no longer sent the signal.
    """
    _LIBC.prctl(_PR_SET_PDEATHSIG, number)


def ended_with_parent(number: int) -> Callable[[], None]:
    """Return a `preexec_fn` after which the kernel sends the child this signal when this process ends."""
    parent = os.getpid()

    def prepare() -> None:
        signal_at_parent_death(number)
        if os.getppid() != parent:  # the parent has ended already
            os.kill(os.getpid(), number)

    return prepare
