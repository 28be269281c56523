"""The daemon's end of the socket to a decoder process: sends requests and receives replies on the event loop."""

import asyncio
import pickle
from collections.abc import Callable

from resonator_daemon.measure.decoder_process.messages import LENGTH, Reply, Request, packed


class WorkerConnection(asyncio.Protocol):
    """Protocol that writes requests without waiting and splits what it reads into replies.

    Parameters
    ----------
    on_reply
        Called with each reply.
    on_lost
        Called when the other end is closed.
    """

    def __init__(self, on_reply: Callable[[Reply], None], on_lost: Callable[[], None]) -> None:
        self._on_reply = on_reply
        self._on_lost = on_lost
        self._transport: asyncio.Transport | None = None
        self._received = bytearray()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if isinstance(transport, asyncio.Transport):
            self._transport = transport

    def send(self, request: Request) -> None:
        """Write a request; ignored after `close`."""
        if self._transport is not None:
            self._transport.write(packed(request))

    def close(self) -> None:
        """Close the connection at once; neither `on_reply` nor `on_lost` is called any more."""
        if self._transport is not None:
            self._transport.abort()
            self._transport = None

    def data_received(self, data: bytes) -> None:
        self._received += data
        while self._transport is not None and len(self._received) >= LENGTH.size:
            (length,) = LENGTH.unpack_from(self._received)
            end = LENGTH.size + length
            if len(self._received) < end:
                return
            with memoryview(self._received) as view:
                reply: Reply = pickle.loads(view[LENGTH.size : end])
            del self._received[:end]
            self._on_reply(reply)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._transport is not None:
            self._transport = None
            self._on_lost()
