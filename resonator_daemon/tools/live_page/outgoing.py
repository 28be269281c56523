"""What waits for one browser: the newest message of each stream, and all others in order."""

import asyncio
from collections import deque
from typing import Final

WAITING_MAX: Final = 2000  # messages other than streams
WAITING_BYTES_MAX: Final = 64 << 20


class Outgoing:
    """Messages for one browser, which its sender takes one after the other; nothing here waits.

    Attributes
    ----------
    skipped
        Messages of streams that were replaced by newer ones before they were sent.
    overflowed
        Whether a message other than those of streams was dropped, because too many waited: the browser has to begin
        again.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self.overflowed = False
        self._others: deque[bytes | str] = deque()
        self._bytes = 0
        self._streams: dict[str, bytes | str] = {}
        self._some = asyncio.Event()

    def put(self, message: bytes | str) -> None:
        """Append a message that must arrive."""
        if len(self._others) >= WAITING_MAX or self._bytes + len(message) > WAITING_BYTES_MAX:
            self.overflowed = True
        else:
            self._others.append(message)
            self._bytes += len(message)
        self._some.set()

    def put_newest(self, stream: str, message: bytes | str) -> None:
        """Put a message of a stream in the place of the one that waits."""
        self.skipped += stream in self._streams
        self._streams[stream] = message
        self._some.set()

    def clear_streams(self, prefix: str) -> None:
        """Discard what waits of the streams whose names begin with `prefix`."""
        self._streams = {name: message for name, message in self._streams.items() if not name.startswith(prefix)}

    def pop(self) -> bytes | str | None:
        """Remove and return the next message: streams come last, the one that has waited longest first."""
        if self._others:
            message = self._others.popleft()
            self._bytes -= len(message)
            return message
        if self._streams:
            return self._streams.pop(next(iter(self._streams)))
        self._some.clear()
        return None

    async def wait(self) -> None:
        """Wait until there is a message, or one was dropped."""
        await self._some.wait()
