"""A live page in the test's own process, and browsers that follow it."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import aiohttp
from aiohttp import WSMsgType

from resonator_daemon.extensions.live_page.hub import Sources
from resonator_daemon.extensions.live_page.server import LivePage

DEADLINE_S = 30.0


@asynccontextmanager
async def served(sources: Sources, **options: Any) -> AsyncIterator[str]:
    """Serve a page; yields its address."""
    page = LivePage(sources, port=0, **options)
    ready: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    running = asyncio.create_task(page.run(ready.set_result))
    await asyncio.wait([running, ready], return_when=asyncio.FIRST_COMPLETED)
    try:
        yield ready.result()
    finally:
        page.stop()
        await running


@dataclass
class Frame:
    """A payload and its address."""

    address: str
    payload: bytes


Received = Frame | dict[str, Any]


class Browser:
    """A WebSocket whose messages are taken one after the other."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket

    async def ask(self, request: object) -> dict[str, Any]:
        """Send a request, return its answer."""
        await self.socket.send_str(request if isinstance(request, str) else json.dumps(request))
        return await self.key("answer")

    async def refusal(self, request: object) -> str:
        """Send a request that is refused, return the code."""
        return str((await self.ask(request))["error"]["code"])

    async def watch(self, plate: str, *topics: str, source: str = "live") -> dict[str, Any]:
        return await self.ask({"id": 0, "watch": {"source": source, "plate": plate, "topics": topics}})

    async def receive(self) -> Received | None:
        message = await self.socket.receive(DEADLINE_S)
        if message.type is WSMsgType.BINARY:
            length = message.data[0]
            return Frame(message.data[1 : 1 + length].decode(), message.data[1 + length :])
        return json.loads(message.data) if message.type is WSMsgType.TEXT else None

    async def until(self, wanted: Callable[[Received], bool]) -> Any:
        """Return the first message that is wanted; others are discarded."""
        async with asyncio.timeout(DEADLINE_S):
            while (message := await self.receive()) is not None:
                if wanted(message):
                    return message
        raise AssertionError("the connection has ended")

    async def key(self, key: str, wanted: Callable[[Any], bool] = lambda _: True) -> Any:
        """Return the next content of this key that is wanted."""
        return (await self.until(lambda it: isinstance(it, dict) and key in it and wanted(it[key])))[key]

    async def frame(self, address: str, wanted: Callable[[bytes], bool] = lambda _: True) -> bytes:
        """Return the next payload with this address that is wanted."""
        found = await self.until(lambda it: isinstance(it, Frame) and it.address == address and wanted(it.payload))
        return found.payload


@asynccontextmanager
async def browser(url: str, **options: Any) -> AsyncIterator[Browser]:
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{url}ws", max_msg_size=0, **options) as socket:
        yield Browser(socket)
