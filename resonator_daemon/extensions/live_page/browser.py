"""One browser: a task that sends what waits for it, the requests that it makes, and what it has open."""

import asyncio
import socket
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from aiohttp import WSCloseCode, WSMsgType, web

from resonator_daemon.extensions.live_page.library import Recorded
from resonator_daemon.extensions.live_page.player import Player
from resonator_daemon.extensions.live_page.presses import Touches
from resonator_daemon.extensions.live_page.protocol import (
    Outgoing,
    RefusedRequest,
    Request,
    read_number,
    read_request,
    text_frame,
)

REQUEST_BYTES_MAX: Final = 64 * 1024
HEARTBEAT_S: Final = 20.0  # a browser that does not answer a ping is disconnected

_SEND_BUFFER_BYTES: Final = 256 * 1024  # of the system: what is in it is old when it arrives
_TOGETHER_MAX: Final = 16  # requests of one browser that wait for an answer

Handle = Callable[["Browser", Request], Awaitable[dict[str, Any]]]


class Browser:
    """Connection to one browser; `run` returns when it ends.

    Attributes
    ----------
    outgoing
        What is to be sent; a browser that does not read delays nobody else.
    watched
        By source: the plate and the paths of its streams that are sent.
    touches
        Presses of emulated plates.
    opened, players
        Its recordings; by source: what plays them.
    openings
        How often it has opened others.
    """

    def __init__(self, handle: Handle) -> None:
        self.outgoing = Outgoing()
        self.watched: dict[str, tuple[str, frozenset[str]]] = {}
        self.touches = Touches()
        self.opened: Sequence[Path] = ()
        self.players: dict[str, Player] = {}
        self.openings = 0
        self._handle = handle
        self._socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, compress=False, max_msg_size=REQUEST_BYTES_MAX)
        self._answering: set[asyncio.Task[None]] = set()

    def watches(self, source: str, plate: str, path: str) -> bool:
        watched = self.watched.get(source)
        return watched is not None and watched[0] == plate and path in watched[1]

    def show(self, opened: Sequence[Path], recordings: Sequence[Recorded]) -> None:
        """Play other recordings, all from their beginnings."""
        for source in self.players:
            self.outgoing.clear_streams(f"{source}/")
            self.watched.pop(source, None)
        self.opened = opened
        self.players = {
            source: Player(source, recorded, self.outgoing, self.watches)
            for source, recorded in zip("ab", recordings, strict=False)
        }
        self.openings += 1

    async def run(self, request: web.Request) -> web.WebSocketResponse:
        """Serve the browser until it disconnects, or is disconnected."""
        await self._socket.prepare(request)
        if request.transport is not None:
            connection = request.transport.get_extra_info("socket")
            with suppress(OSError):
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        sending = asyncio.create_task(self._send())
        try:
            async for message in self._socket:
                await self._receive(message.data if message.type is WSMsgType.TEXT else "")
        finally:
            sending.cancel()
            for task in self._answering:
                task.cancel()
            await asyncio.gather(sending, *self._answering, return_exceptions=True)
        return self._socket

    async def close(self, code: WSCloseCode, reason: str) -> None:
        with suppress(OSError):
            await self._socket.close(code=code, message=reason.encode())

    async def _send(self) -> None:
        with suppress(OSError):  # it has disconnected, which `run` notices
            while not self.outgoing.overflowed:
                message = await self.outgoing.get()
                if isinstance(message, str):
                    await self._socket.send_str(message)
                elif message is not None:
                    await self._socket.send_bytes(message)
            await self.close(WSCloseCode.TRY_AGAIN_LATER, "too_slow")

    async def _receive(self, text: str) -> None:
        try:
            request = read_request(text)
            if len(self._answering) >= _TOGETHER_MAX:
                raise RefusedRequest("too_many_requests", f"{_TOGETHER_MAX} requests wait for their answers")
        except RefusedRequest as refused:
            self._refuse(read_number(text), refused)
            return
        task = asyncio.create_task(self._answer(request))
        self._answering.add(task)
        task.add_done_callback(self._answering.discard)
        await asyncio.sleep(0)  # so that requests begin in their order

    async def _answer(self, request: Request) -> None:
        try:
            answer = await self._handle(self, request)
        except RefusedRequest as refused:
            self._refuse(request.number, refused)
            return
        if request.number is not None:
            self.outgoing.put(text_frame("answer", {"id": request.number, "ok": True} | answer))

    def _refuse(self, number: int | str | None, refused: RefusedRequest) -> None:
        error = {"code": refused.code, "message": str(refused)}
        self.outgoing.put(text_frame("answer", {"id": number, "ok": False, "error": error}))
