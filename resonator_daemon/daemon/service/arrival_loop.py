"""Passes what the reader's thread delivers to the pipeline, on the event loop and in parts."""

import asyncio
import os
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import Final

from resonator_daemon.board.session.frame_queue import group_adjacent
from resonator_daemon.board.session.frames import Arrival, Frame

PART_ARRIVALS: Final = 50


class ArrivalLoop:
    """Handles arrivals in parts of at most 50, between which the event loop serves messages and signals.

    The thread of the reader wakes the event loop by a counter of the kernel (eventfd): one call on each side, where
    `call_soon_threadsafe` takes five.

    Parameters
    ----------
    pop
        Removes and returns what has arrived.
    handle
        Called with each arrival, or with adjacent frames.
    part
        Makes the context in which each part is handled.
    over
        Ends the handling when it is done; gets what `handle` raises.
    """

    def __init__(
        self,
        pop: Callable[[], Iterable[Arrival]],
        handle: Callable[[Arrival | list[Frame]], None],
        part: Callable[[], AbstractContextManager[None]],
        over: asyncio.Future[None],
    ) -> None:
        self._pop = pop
        self._handle = handle
        self._part = part
        self._over = over
        self._loop = asyncio.get_running_loop()
        self._arrivals: deque[Arrival | list[Frame]] = deque()
        self._pending = False
        self._arrived = False  # since the last `pop`
        self._event = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._loop.add_reader(self._event, self._begin)

    def wake(self) -> None:
        """Handle what has arrived; from any thread."""
        if not self._pending:
            self._pending = True
            os.eventfd_write(self._event, 1)

    def close(self) -> None:
        """Stop handling: `wake` does nothing any more."""
        self._pending = True
        self._loop.remove_reader(self._event)
        os.close(self._event)

    def _begin(self) -> None:
        os.eventfd_read(self._event)
        self._pending = False
        self._arrived = True
        if not self._arrivals:  # else the next part is scheduled already
            self._handle_next()

    def _handle_next(self) -> None:
        try:
            with self._part():
                finished = self._handle_part()
        except Exception as error:  # noqa: BLE001 - `over` raises it
            if not self._over.done():
                self._over.set_exception(error)
        else:
            if not (finished or self._over.done()):
                self._loop.call_soon(self._handle_next)

    def _handle_part(self) -> bool:
        """Return whether no arrival was left."""
        handled = 0
        while handled < PART_ARRIVALS and not self._over.done():
            if not self._arrivals:
                if not self._arrived:
                    return True
                self._arrived = False
                self._arrivals.extend(group_adjacent(self._pop(), PART_ARRIVALS))
                continue
            arrival = self._arrivals.popleft()
            self._handle(arrival)
            handled += len(arrival) if isinstance(arrival, list) else 1
        return False
