"""Server of the live page: files, and a WebSocket for each browser; the implementation of `resonatord view`."""

import asyncio
import signal
import ssl
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from aiohttp import WSCloseCode, web

from resonator_daemon.config import Mqtt
from resonator_daemon.config.mqtt import is_this_computer
from resonator_daemon.errors import ExitCode, UsageError, UserError
from resonator_daemon.host.system_limits import meaning_of
from resonator_daemon.host.systemd import ServiceManager
from resonator_daemon.live_page.access import Access
from resonator_daemon.live_page.broker_relay import CONNECTING, BrokerRelay
from resonator_daemon.live_page.client import Client
from resonator_daemon.live_page.frames import LIVE, payload_frame, text_frame
from resonator_daemon.live_page.requests import Command, RefusedRequest, Request, Watch
from resonator_daemon.publishing.requests import request as send_command
from resonator_daemon.publishing.topics import TOPICS

CLIENTS_MAX: Final = 32
COMMANDS: Final = ("tare", "mark", "start_recording", "stop_recording")

_REPORT_S: Final = 1.0


class ListenError(UserError):
    """The address cannot be listened on now."""

    exit_code = ExitCode.FAILED
    code = "listen"


@dataclass(frozen=True)
class LivePageOptions:
    """What to show, where, and to whom.

    Parameters
    ----------
    broker
        Whose plates are shown.
    host, port
        To listen on; port 0 selects a free one.
    token
        That browsers have to send; required if `host` is not this computer's own.
    tls
        Certificate of the server; likewise.
    allow_commands
        Whether browsers may send commands to the daemons.
    """

    broker: Mqtt
    host: str = "127.0.0.1"
    port: int = 8600
    token: str | None = None
    tls: ssl.SSLContext | None = None
    allow_commands: bool = False


class LivePage:
    """The page, its browsers and what it shows.

    Raises
    ------
    UsageError
        Other computers could reach the page without a token, or without TLS.
    """

    def __init__(self, options: LivePageOptions) -> None:
        if not is_this_computer(options.host) and (options.token is None or options.tls is None):
            raise UsageError(
                f"--listen {options.host}: other computers can reach this address; give --token-file, "
                "--tls-certificate and --tls-key, or listen on 127.0.0.1"
            )
        self._options = options
        self._clients: set[Client] = set()
        self._retained: dict[tuple[str, str], bytes] = {}  # by plate and path: messages to the page
        self._status: dict[str, Any] = {"connected": False, "reason_code": CONNECTING, "reason": ""}
        self._relay = BrokerRelay(options.broker, self._relay_message, self._set_status)
        self._ending = asyncio.Event()

    async def run(self, on_ready: Callable[[str], None]) -> None:
        """Serve until `stop`; calls `on_ready` with the page's address.

        Raises
        ------
        ListenError
            The address is in use, or not this computer's.
        """
        runner = web.AppRunner(self._make_app(), access_log=None, handle_signals=False, shutdown_timeout=1.0)
        await runner.setup()
        host = "127.0.0.1" if self._options.host == "localhost" else self._options.host
        try:
            await self._listen(runner, host)
            _, port, *_ = runner.addresses[0]
            on_ready(f"{'https' if self._options.tls else 'http'}://{f'[{host}]' if ':' in host else host}:{port}/")
            await self._serve()
        finally:
            for client in list(self._clients):
                await client.close(WSCloseCode.GOING_AWAY, "stopping")
            await runner.cleanup()

    def stop(self) -> None:
        """End `run`."""
        self._ending.set()

    async def _listen(self, runner: web.AppRunner, host: str) -> None:
        try:
            await web.TCPSite(runner, host, self._options.port, ssl_context=self._options.tls).start()
        except OSError as error:
            where = f"{host}:{self._options.port}"
            raise ListenError(
                f"cannot listen on {where}: {meaning_of(error)}; --listen selects another address"
            ) from None

    async def _serve(self) -> None:
        manager = ServiceManager()
        tasks = [asyncio.create_task(self._relay.run()), asyncio.create_task(self._report(manager))]
        ending = asyncio.create_task(self._ending.wait())
        manager.ready("serving")
        try:
            await asyncio.wait([*tasks, ending], return_when=asyncio.FIRST_COMPLETED)
        finally:
            manager.stopping()
            self._relay.close()
            for task in (*tasks[1:], ending):
                task.cancel()
            done = await asyncio.gather(*tasks, ending, return_exceptions=True)
        for result in done:
            if isinstance(result, Exception):
                raise result

    def _make_app(self) -> web.Application:
        page = Path(str(resources.files("resonator_daemon") / "live_page" / "page"))
        app = web.Application()
        Access(self._options.host, self._options.token, tls=self._options.tls is not None).protect(app)

        async def index(_request: web.Request) -> web.StreamResponse:
            return web.FileResponse(page / "index.html")

        app.router.add_get("/", index)
        app.router.add_get("/ws", self._connect)
        app.router.add_static("/", page)
        return app

    async def _connect(self, request: web.Request) -> web.StreamResponse:
        if len(self._clients) >= CLIENTS_MAX:
            raise web.HTTPServiceUnavailable(text=f'{{"error": {{"code": "too_many_clients", "max": {CLIENTS_MAX}}}}}')
        client = Client(self._answer)
        client.outgoing.put(self._hello())
        client.outgoing.put(text_frame("broker", self._status))
        for message in self._retained.values():
            client.outgoing.put(message)
        self._clients.add(client)
        try:
            return await client.run(request)
        finally:
            self._clients.discard(client)
            self._update_watched()

    def _hello(self) -> str:
        source = {"source": LIVE, "url": self._options.broker.anonymous().url}
        commands = COMMANDS if self._options.allow_commands else ()
        hello = {"version": version("resonatord"), "sources": [source], "commands": commands, "press": []}
        return text_frame("hello", hello)

    def _relay_message(self, plate: str, path: str, payload: bytes) -> None:
        message = payload_frame(LIVE, plate, path, payload)
        if message is None:
            return
        topic = TOPICS[path]
        if topic.retained:
            self._retained.pop((plate, path), None)
            if payload:
                self._retained[plate, path] = message
        for client in self._clients:
            if topic.qos:
                client.outgoing.put(message)
            elif client.watches(LIVE, plate, path):
                client.outgoing.put_newest(f"{LIVE}/{plate}/{path}", message)

    def _set_status(self, status: dict[str, Any]) -> None:
        if status != self._status:
            self._status = status
            for client in self._clients:
                client.outgoing.put(text_frame("broker", status))

    async def _report(self, manager: ServiceManager) -> None:
        while True:
            await asyncio.sleep(_REPORT_S)
            manager.alive()
            for client in self._clients:
                content = {"count": len(self._clients), "skipped": client.outgoing.skipped}
                client.outgoing.put_newest("clients", text_frame("clients", content))

    async def _answer(self, client: Client, request: Request) -> dict[str, Any]:
        match request.content:
            case Watch() as watch:
                return self._watch(client, watch)
            case Command() as command:
                return await self._command(command)
        raise RefusedRequest("unknown_source", "there is nothing of this kind to press or to play")

    def _watch(self, client: Client, watch: Watch) -> dict[str, Any]:
        if watch.source != LIVE:
            raise RefusedRequest("unknown_source", f"source: {watch.source}; this page has {LIVE}")
        if any(sign in watch.plate for sign in "/+#\0"):
            raise RefusedRequest("unknown_plate", f"plate: {watch.plate!r} is no name of a plate")
        client.outgoing.clear_streams(f"{watch.source}/")
        client.watched[watch.source] = (watch.plate, watch.topics)
        self._update_watched()
        return {}

    def _update_watched(self) -> None:
        watched = [client.watched[LIVE] for client in self._clients if LIVE in client.watched]
        self._relay.watch({(plate, path) for plate, paths in watched for path in paths})

    async def _command(self, command: Command) -> dict[str, Any]:
        if not self._options.allow_commands:
            raise RefusedRequest(
                "read_only", "this page is read-only; `resonatord view --allow-commands` sends commands"
            )
        if command.verb not in COMMANDS:
            raise RefusedRequest("unknown_verb", f"verb: {command.verb!r}; must be one of {', '.join(COMMANDS)}")
        if not any(plate == command.plate for plate, _ in self._retained):
            raise RefusedRequest("unknown_plate", f"plate: {command.plate!r} publishes nothing")
        try:
            answer = await send_command(self._options.broker, command.plate, command.verb, command.arguments)
        except UserError as error:
            raise RefusedRequest(error.code, str(error)) from None
        return {key: value for key, value in answer.items() if key != "id"}


async def serve(options: LivePageOptions, on_ready: Callable[[str], None]) -> None:
    """Serve the page until SIGINT, SIGTERM or SIGHUP."""
    page = LivePage(options)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, page.stop)
    with suppress(asyncio.CancelledError):
        await page.run(on_ready)
