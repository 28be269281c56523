"""One browser: a task that sends what waits for it, and the requests that it makes."""

import asyncio
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any, Final

from aiohttp import WSCloseCode, WSMsgType, web

from resonator_daemon.tools.live_page.frames import refusal, text_frame
from resonator_daemon.tools.live_page.outgoing import Outgoing
from resonator_daemon.tools.live_page.requests import (
    RefusedRequest,
    Request,
    read_number,
    read_request,
)

REQUEST_BYTES_MAX: Final = 64 * 1024
HEARTBEAT_S: Final = 20.0  # a browser that does not answer a ping is disconnected

_SEND_BUFFER_BYTES: Final = 256 * 1024  # of the system: what is in it is old when it arrives
_TOGETHER_MAX: Final = 16  # requests of one browser that wait for an answer

Handle = Callable[["Client", Request], Awaitable[dict[str, Any]]]


class Client:
    """Connection to one browser; `run` returns when it ends.

    Attributes
    ----------
    outgoing
        What is to be sent; a browser that does not read delays nobody else.
    watched
        By source: the plate and the paths of its streams that are sent.
    """

    def __init__(self, handle: Handle) -> None:
        self.outgoing = Outgoing()
        self.watched: dict[str, tuple[str, frozenset[str]]] = {}
        self._handle = handle
        self._socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, compress=False, max_msg_size=REQUEST_BYTES_MAX)
        self._answering: set[asyncio.Task[None]] = set()

    def watches(self, source: str, plate: str, path: str) -> bool:
        watched = self.watched.get(source)
        return watched is not None and watched[0] == plate and path in watched[1]

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
                await self._receive(message.type, message.data)
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
                await self.outgoing.wait()
                while (message := self.outgoing.pop()) is not None:
                    if isinstance(message, str):
                        await self._socket.send_str(message)
                    else:
                        await self._socket.send_bytes(message)
            await self.close(WSCloseCode.TRY_AGAIN_LATER, "too_slow")

    async def _receive(self, kind: WSMsgType, data: Any) -> None:
        text = data if kind is WSMsgType.TEXT else ""
        number = read_number(text)
        try:
            request = read_request(text)
            if len(self._answering) >= _TOGETHER_MAX:
                raise RefusedRequest("too_many_requests", f"{_TOGETHER_MAX} requests wait for their answers")
        except RefusedRequest as refused:
            self.outgoing.put(refusal(number, refused.code, str(refused)))
            return
        task = asyncio.create_task(self._answer(request))
        self._answering.add(task)
        task.add_done_callback(self._answering.discard)
        await asyncio.sleep(0)  # so that requests begin in their order

    async def _answer(self, request: Request) -> None:
        try:
            answer = await self._handle(self, request)
        except RefusedRequest as refused:
            self.outgoing.put(refusal(request.number, refused.code, str(refused)))
            return
        if request.number is not None:
            self.outgoing.put(text_frame("answer", {"id": request.number, "ok": True} | answer))
