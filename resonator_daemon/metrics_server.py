"""Serves the metrics to Prometheus over HTTP, one request after the other."""

import asyncio
import logging
import socket
import socketserver
from collections.abc import Callable
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app

from resonator_daemon.config import Listen
from resonator_daemon.metrics import StatusCollector
from resonator_daemon.status import Status

_REQUEST_S: Final = 1.0  # without a byte of a request
_PAUSE_S: Final = 0.05  # between requests: who asks without end cannot slow the daemon
_AGAIN_S: Final = 5.0

log = logging.getLogger(__name__)


class MetricsServer:
    """Answers on an address as long as `run` does; that the address cannot be had is said once and tried again.

    Parameters
    ----------
    listen
        Where.
    collect
        Takes stock; called on the event loop's thread, once for each connection. The request itself is read and
        answered in a thread.
    """

    def __init__(self, listen: Listen, collect: Callable[[], Status]) -> None:
        self._listen = listen
        self._collect = collect
        self._said: str | None = None

    async def run(self) -> None:
        """Answer until cancelled."""
        while True:
            try:
                server = await asyncio.to_thread(_Server, self._listen)  # a host's name may take its time
            except OSError as error:
                self._say(error.strerror or str(error))
                await asyncio.sleep(_AGAIN_S)
                continue
            self._say(None)
            with server:
                await self._answer_all(server)

    async def _answer_all(self, server: "_Server") -> None:
        while True:
            await _readable(server.socket)
            server.collector.status = self._collect()
            await asyncio.to_thread(server.handle_request)
            await asyncio.sleep(_PAUSE_S)

    def _say(self, problem: str | None) -> None:
        if problem is not None and problem != self._said:
            log.warning(
                "no metrics at %s: %s; see listen in [metrics], and who else has the port: ss -tlnp",
                self._listen,
                problem,
            )
        elif problem is None:
            log.info("metrics at http://%s/metrics", self._listen)
        self._said = problem


class _Server(WSGIServer):
    """A server of one thread, whose requests end by themselves."""

    timeout = 0  # of handle_request, for a client that has left meanwhile

    def __init__(self, listen: Listen) -> None:
        self.address_family = socket.getaddrinfo(listen.host, listen.port, type=socket.SOCK_STREAM)[0][0]
        self.collector = StatusCollector()
        registry = CollectorRegistry()
        registry.register(self.collector)
        super().__init__((listen.host, listen.port), _Handler)
        self.socket.setblocking(False)  # a client that left between select and accept is not waited for
        self.set_app(make_wsgi_app(registry))

    def server_bind(self) -> None:
        # As WSGIServer does, without asking the name service for this computer's own name, which may take seconds.
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]
        self.setup_environ()

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("a request for metrics from %s came to nothing", client_address)


class _Handler(WSGIRequestHandler):
    timeout = _REQUEST_S

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing of single requests."""


async def _readable(watched: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    ready = loop.create_future()

    def arrived() -> None:
        if not ready.done():
            ready.set_result(None)

    loop.add_reader(watched.fileno(), arrived)
    try:
        await ready
    finally:
        loop.remove_reader(watched.fileno())
