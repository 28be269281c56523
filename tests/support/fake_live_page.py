"""A server for the live page that sends what a script gives it, with the headers of the real one."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib import resources
from pathlib import Path
from typing import Any

import cbor2
import numpy as np
from aiohttp import WSMsgType, web
from numpy.typing import ArrayLike

from resonator_daemon.extensions.live_page.access import Access

PAGE = Path(str(resources.files("resonator_daemon.extensions.live_page") / "page"))
LIVE = {"source": "live", "url": "mqtt://127.0.0.1:1883"}
OUTLINE = [[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]]
PITCH = 0.4e-3  # of the map of a skin, 32 x 32
ORIGIN = -15.5 * PITCH


def array(values: ArrayLike) -> cbor2.CBORTag:
    """Return a float32 array as RFC 8746 has it."""
    numbers = np.asarray(values, "<f4")
    return cbor2.CBORTag(40, [list(numbers.shape), cbor2.CBORTag(85, numbers.tobytes())])


def header(**keys: Any) -> dict[str, Any]:
    known = {"name": "p", "seq": 1, "daemon_boot_id": "run", "t_ns": str(time.time_ns()), "t_uncertainty_ns": 42000}
    return known | {"lost": {}} | keys


def info(skin: bool = False, sites: int = 2, **keys: Any) -> dict[str, Any]:
    """Description of a plate of 20 mm, sites in a row; of a skin with a map of 32 x 32."""
    places = [{"site": n + 1, "position_m": [-0.008 + 0.016 * n / max(1, sites - 1), 0.004]} for n in range(sites)]
    known = {"plate": "p", "schema_version": "2.0", "counter": "channelised" if skin else "single-tone"}
    known |= {"sites": places}
    known |= {"outline_m": OUTLINE, "transducers_m": OUTLINE, "force_max_newton": 10, "commands": ["tare", "mark"]}
    known |= {"frame_rate_hz": 1000, "skin": {"depth_m": 0.001} if skin else None, "units": {"m": "m"}}
    return header(**known | keys)


def contact(force: ArrayLike = (None, None, 1.5), **keys: Any) -> dict[str, Any]:
    known = {
        "id": 7, "site": 1, "position_m": [0.001, 0.002], "position_covariance_m2": [4e-8, 0, 1e-8], "status": "ok"
    }  # fmt: skip
    return known | {"force_newton": list(force), "noise_newton": [0.003, 0.003, 0.003]} | keys  # type: ignore[call-overload]


def hertz(force_newton: float, radius_m: float) -> np.ndarray:
    """Tractions (3, 32, 32) of a Hertz contact at the origin, sheared to x by a quarter of its pressure."""
    place = ORIGIN + PITCH * np.arange(32)
    share = 1 - (place**2 + place[:, None] ** 2) / radius_m**2
    pressure = 1.5 * force_newton / (np.pi * radius_m**2) * np.sqrt(np.clip(share, 0, None))
    return np.array([0.25 * pressure, 0 * pressure, pressure])


def decoded(traction: ArrayLike, **keys: Any) -> bytes:
    known = header(t_ns=time.time_ns(), traction_pascal=array(traction), traction_std_pascal=None, displacement_m=None)
    return cbor2.dumps(known | {"grid": {"origin_m": [ORIGIN, ORIGIN], "pitch_m": PITCH}} | keys)


class FakeLivePage:
    """What the page is sent, and what it asked for; `answer` makes the answer to a request."""

    def __init__(self) -> None:
        self.hello: dict[str, Any] = {"version": "0", "sources": [LIVE], "commands": [], "press": []}
        self.retained: dict[str, bytes] = {}
        self.requests: list[dict[str, Any]] = []
        self.answer: Callable[[dict[str, Any]], dict[str, Any]] = lambda _request: {"ok": True}
        self.url = ""
        self._sockets: set[web.WebSocketResponse] = set()
        self._arrived = asyncio.Condition()

    async def send(self, path: str, payload: dict[str, Any] | bytes, plate: str = "p", source: str = "live") -> None:
        """Send a payload; JSON unless it is bytes. What is retained comes first to later connections, too."""
        content = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
        address = f"{source}/{plate}/{path}".encode()
        message = bytes([len(address)]) + address + content
        if path == "info" or path.startswith("state/"):
            self.retained[f"{source}/{plate}/{path}"] = message
        for socket in self._sockets:
            await socket.send_bytes(message)

    async def send_text(self, **message: Any) -> None:
        """Send a text message of these keys."""
        for socket in self._sockets:
            await socket.send_str(json.dumps(message))

    async def disconnect(self) -> None:
        for socket in list(self._sockets):
            await socket.close()

    async def until(self, key: str, count: int = 1, seconds: float = 10.0) -> list[Any]:
        """Return the requests of this key, once there are so many."""
        async with asyncio.timeout(seconds), self._arrived:
            await self._arrived.wait_for(lambda: len(self.asked(key)) >= count)
        return self.asked(key)

    def asked(self, key: str) -> list[Any]:
        return [request[key] for request in self.requests if key in request]

    async def _connect(self, request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(compress=False)
        await socket.prepare(request)
        await socket.send_str(json.dumps({"hello": self.hello}))
        await socket.send_str(json.dumps({"broker": {"connected": True, "reason_code": "", "reason": ""}}))
        for message in self.retained.values():
            await socket.send_bytes(message)
        self._sockets.add(socket)
        try:
            async for message in socket:
                if message.type is WSMsgType.TEXT:
                    await self._receive(socket, json.loads(message.data))
        finally:
            self._sockets.discard(socket)
        return socket

    async def _receive(self, socket: web.WebSocketResponse, request: dict[str, Any]) -> None:
        if "id" in request:
            await socket.send_str(json.dumps({"answer": {"id": request["id"]} | self.answer(request)}))
        async with self._arrived:
            self.requests.append(request)
            self._arrived.notify_all()


@asynccontextmanager
async def served() -> AsyncIterator[FakeLivePage]:
    """Serve the page's files and a WebSocket on a free port of this computer."""
    fake = FakeLivePage()

    async def index(_request: web.Request) -> web.FileResponse:
        return web.FileResponse(PAGE / "index.html")

    app = web.Application()
    Access("127.0.0.1", None, tls=False).protect(app)
    app.router.add_get("/", index)
    app.router.add_get("/ws", fake._connect)
    app.router.add_static("/", PAGE)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    fake.url = f"http://127.0.0.1:{runner.addresses[0][1]}/"
    try:
        yield fake
    finally:
        await fake.disconnect()
        await runner.cleanup()
