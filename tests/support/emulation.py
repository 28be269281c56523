"""Emulated boards in a thread of the test's own process."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from simulators.emulator import Emulator, EmulatorOptions


@contextmanager
def emulated(options: EmulatorOptions) -> Iterator[Emulator]:
    emulator = Emulator(options)
    thread = threading.Thread(target=emulator.run)
    thread.start()
    try:
        yield emulator
    finally:
        emulator.stop()
        thread.join()
