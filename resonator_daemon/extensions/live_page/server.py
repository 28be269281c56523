"""Server of the live page: files, and a WebSocket for each browser; the implementation of `resonatord view`."""

import asyncio
import logging
import mimetypes
import os
import socket
import ssl
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, Final

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from resonator_daemon.base.errors import ListenError, UsageError, meaning_of
from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.base.host.systemd import ServiceManager
from resonator_daemon.board.config.mqtt import is_this_computer
from resonator_daemon.extensions.live_page.access import Access
from resonator_daemon.extensions.live_page.hub import Hub, Sources

BROWSERS_MAX: Final = 32

_ALIVE_S: Final = 1.0
_CLIENT_ERRORS: Final = (HttpProcessingError, ConnectionError)

log = logging.getLogger(__name__)
log.addFilter(lambda record: record.exc_info is None or not isinstance(record.exc_info[1], _CLIENT_ERRORS))


class LivePage:
    """The page at its address.

    Parameters
    ----------
    sources
        What is shown.
    host, port
        To listen on; port 0 selects a free one.
    token
        That browsers have to send; required if `host` is not this computer's own.
    tls
        Certificate of the server; likewise.

    Raises
    ------
    UsageError
        Other computers could reach the page without a token, or without TLS.
    """

    def __init__(
        self,
        sources: Sources,
        *,
        host: str = "127.0.0.1",
        port: int = 8600,
        token: str | None = None,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        if not is_this_computer(host) and (token is None or tls is None):
            raise UsageError(
                f"--listen {host}: other computers can reach this address; give --token-file, "
                "--tls-certificate and --tls-key, or listen on 127.0.0.1"
            )
        self._host = "127.0.0.1" if host == "localhost" else host
        self._port = port
        self._tls = tls
        self._access = Access(host, token, tls=tls is not None)
        self._hub = Hub(sources)
        self._ending = asyncio.Event()

    async def run(self, on_ready: Callable[[str], None]) -> None:
        """Serve until `stop`; calls `on_ready` with the page's address.

        Raises
        ------
        ListenError
            The address is in use, or not this computer's.
        """
        options: dict[str, Any] = {"access_log": None, "logger": log, "auto_decompress": False, "shutdown_timeout": 1.0}
        runner = web.AppRunner(self._make_app(), handle_signals=False, **options)
        await runner.setup()
        host = self._host
        try:
            await self._listen(runner)
            _, port, *_ = runner.addresses[0]
            name = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
            on_ready(f"{'https' if self._tls else 'http'}://{name}:{port}/")
            await self._serve()
        finally:
            await self._hub.disconnect_all()
            await runner.cleanup()

    def stop(self) -> None:
        """End `run`."""
        self._ending.set()

    async def _listen(self, runner: web.AppRunner) -> None:
        try:
            await web.TCPSite(runner, self._host, self._port, ssl_context=self._tls).start()
        except OSError as error:
            why = os.strerror(error.errno) if error.errno else meaning_of(error)  # asyncio puts the address before it
            raise ListenError(
                f"cannot listen on {self._host}:{self._port}: {why}; --listen selects another address"
            ) from None

    async def _serve(self) -> None:
        manager = ServiceManager()
        tasks = [
            asyncio.create_task(self._hub.run()),
            asyncio.create_task(_keep_alive(manager)),
            asyncio.create_task(self._ending.wait()),
        ]
        manager.ready("serving the live page")
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            manager.stopping()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            task.result()

    def _make_app(self) -> web.Application:
        page = Path(str(resources.files("resonator_daemon.extensions.live_page") / "page"))
        files = {path.relative_to(page).as_posix(): path.read_bytes() for path in page.rglob("*.*")}
        app = web.Application()
        self._access.protect(app)

        async def send_file(request: web.Request) -> web.StreamResponse:
            name = request.match_info["name"] or "index.html"
            if name not in files:
                raise web.HTTPNotFound
            return web.Response(body=files[name], content_type=mimetypes.guess_type(name)[0], charset="utf-8")

        app.router.add_get("/ws", self._connect)
        app.router.add_get("/{name:.*}", send_file)
        return app

    async def _connect(self, request: web.Request) -> web.StreamResponse:
        if self._hub.browsers >= BROWSERS_MAX:
            body = f'{{"error": {{"code": "too_many_browsers", "message": "{BROWSERS_MAX} are connected; close one"}}}}'
            return web.Response(status=503, text=body, content_type="application/json")
        return await self._hub.connect(request)


async def _keep_alive(manager: ServiceManager) -> None:
    while True:
        manager.alive()
        await asyncio.sleep(_ALIVE_S)


async def serve(page: LivePage, on_ready: Callable[[str], None]) -> None:
    """Serve the page until SIGINT, SIGTERM or SIGHUP."""
    with on_signals(lambda _: page.stop()):
        await page.run(on_ready)
