"""Notices that a link has brought no frames for so long that nothing can be said of the contacts any more."""

import asyncio
from collections.abc import Callable
from typing import Final

CONTACTS_END_S: Final = 0.5  # as long as a contact of which nothing is known is kept while frames do come


class Silence:
    """Calls back once when the link has not been online for half a second.

    Parameters
    ----------
    loop
        Whose time it is.
    announce
        Called with the reason, on the loop.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, announce: Callable[[str], None]) -> None:
        self._loop = loop
        self._announce = announce
        self._timer: asyncio.TimerHandle | None = None

    def watch(self, link_state: str) -> None:
        """Take the link's state as it changes."""
        if link_state == "online":
            self.stop()
        elif self._timer is None:
            self._timer = self._loop.call_later(CONTACTS_END_S, self._announce, f"no frames for {CONTACTS_END_S:g} s")

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
