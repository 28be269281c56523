"""Serves the metrics to Prometheus over HTTP, a few requests at a time, none for longer than a second."""

import asyncio
import contextlib
import logging
import socket
import socketserver
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, NoReturn
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer
from wsgiref.types import StartResponse, WSGIEnvironment

from prometheus_client import CollectorRegistry, make_wsgi_app

from resonator_daemon.config import Listen
from resonator_daemon.monitoring.metrics import StatusCollector
from resonator_daemon.monitoring.status import Status

_REQUEST_S: Final = 1.0  # from the first byte of a request to the last one of its answer
_TOGETHER: Final = 8  # connections that are served, in a thread each; the others wait for the end of one
_WAITING: Final = 64
_PAUSE_S: Final = 0.05  # between connections: who asks without end cannot slow the daemon
_AGAIN_S: Final = 5.0
_PATH: Final = "/metrics"

log = logging.getLogger(__name__)


class MetricsServer:
    """Answers on an address as long as `run` does; that the address cannot be had is said once and tried again.

    Parameters
    ----------
    listen
        Where.
    collect
        Takes stock; called on the event loop's thread, once for each connection. The request itself is read and
        answered in a thread of its own.
    """

    def __init__(self, listen: Listen, collect: Callable[[], Status]) -> None:
        self._listen = listen
        self._collect = collect
        self._problem: str | None = None

    async def run(self) -> None:
        """Answer until cancelled."""
        while True:
            try:
                with await asyncio.to_thread(_Server, self._listen) as server:  # a host's name may take its time
                    self._log_change(None)
                    await self._answer_all(server)
            except OSError as error:
                self._log_change(error.strerror or str(error))
                await asyncio.sleep(_AGAIN_S)

    async def _answer_all(self, server: "_Server") -> NoReturn:
        loop, room = asyncio.get_running_loop(), asyncio.Semaphore(_TOGETHER)
        threads = ThreadPoolExecutor(_TOGETHER, thread_name_prefix="metrics")
        refused: OSError | None = None
        try:
            async with asyncio.TaskGroup() as answers:
                while refused is None:
                    await room.acquire()
                    try:
                        request, address = await loop.sock_accept(server.socket)
                    except OSError as error:
                        refused = error  # as without file descriptors
                        continue
                    server.collector.status = self._collect()
                    answers.create_task(_answer(server, threads, room, request, address))
                    await asyncio.sleep(_PAUSE_S)
        finally:
            threads.shutdown(wait=False)
        raise refused

    def _log_change(self, problem: str | None) -> None:
        if problem is not None and problem != self._problem:
            log.warning(
                "no metrics at %s: %s; see listen in [metrics], and who else has the port: ss -tlnp",
                self._listen,
                problem,
            )
        elif problem is None:
            log.info("metrics at http://%s%s", self._listen, _PATH)
        self._problem = problem


class _Server(WSGIServer):
    """Has the address; connections are accepted for it."""

    request_queue_size = _WAITING

    def __init__(self, listen: Listen) -> None:
        self.address_family = socket.getaddrinfo(listen.host, listen.port, type=socket.SOCK_STREAM)[0][0]
        self.collector = StatusCollector()
        registry = CollectorRegistry()
        registry.register(self.collector)
        super().__init__((listen.host, listen.port), _Handler)
        self.socket.setblocking(False)
        metrics = make_wsgi_app(registry)
        self.set_app(lambda asked, answer: (metrics if asked["PATH_INFO"] == _PATH else _not_found)(asked, answer))

    def server_bind(self) -> None:
        # As WSGIServer does, without asking the name service for this computer's own name, which may take seconds.
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]
        self.setup_environ()

    def answer(self, request: socket.socket, client_address: Any) -> None:
        """Read a request and answer it; blocks until then, or until the connection is shut."""
        try:
            self.finish_request(request, client_address)
        except OSError:
            log.debug("a request for metrics from %s came to nothing", client_address)
        finally:
            self.shutdown_request(request)


def _not_found(_asked: WSGIEnvironment, answer: StartResponse) -> list[bytes]:
    answer("404 Not Found", [("Content-Type", "text/plain; charset=utf-8")])
    return [f"not here; the metrics are at {_PATH}\n".encode()]


class _Handler(WSGIRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Log no single requests."""


async def _answer(
    server: _Server, threads: ThreadPoolExecutor, room: asyncio.Semaphore, request: socket.socket, address: object
) -> None:
    loop = asyncio.get_running_loop()
    request.setblocking(True)
    deadline = loop.call_later(_REQUEST_S, _shut, request)
    try:
        await loop.run_in_executor(threads, server.answer, request, address)
    finally:
        deadline.cancel()
        _shut(request)  # the thread ends when this task is cancelled, too
        room.release()


def _shut(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # its thread may have closed it
        connection.shutdown(socket.SHUT_RDWR)
