"""Metrics for Prometheus over HTTP: few connections, none for longer than a second, and 20 answers a second at most."""

import asyncio
import logging
import re
import socket
from collections.abc import Callable
from email.parser import Parser
from typing import Any, Final, NamedTuple

from prometheus_client import CollectorRegistry, make_wsgi_app

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.board.config.tables import Listen
from resonator_daemon.daemon.monitoring.metrics import StatusCollector
from resonator_daemon.daemon.monitoring.status import Status

TOGETHER: Final = 8  # connections; further ones are closed
_BACKLOG: Final = 100
_PATH: Final = "/metrics"
_REQUEST: Final = re.compile(rf"([A-Z]+) {_PATH}(?:\?\S*)? HTTP/1\.[01]\r\n")

log = logging.getLogger(__name__)


class MetricsTimes(NamedTuple):
    """Time limits and pauses of a metrics server, in seconds."""

    request_s: float = 1.0  # from the beginning of a connection to its end
    pause_s: float = 0.05  # after an answer
    retry_s: float = 5.0  # after a failure


class MetricsServer:
    """Answers on an address as long as `run` does; a failure is logged once and retried.

    Parameters
    ----------
    listen
        The address.
    make
        Makes the status; called on the event loop's thread for each request.
    times
    """

    def __init__(self, listen: Listen, make: Callable[[], Status], times: MetricsTimes | None = None) -> None:
        self._listen = listen
        self._make = make
        self._times = times or MetricsTimes()
        self._collector = StatusCollector()
        registry = CollectorRegistry()
        registry.register(self._collector)
        self._app = make_wsgi_app(registry)
        self._answering = asyncio.Lock()
        self._connections = 0
        self._problem: str | None = None

    async def run(self) -> None:
        """Answer until cancelled."""
        # Not asyncio's server: without free descriptors it logs a hundred errors a second.
        serving: set[asyncio.Task[None]] = set()
        while True:
            try:
                with await asyncio.to_thread(_listening_socket, self._listen) as listening:  # may resolve a name
                    self._log_change(None)
                    while True:
                        client, _ = await asyncio.get_running_loop().sock_accept(listening)
                        task = asyncio.create_task(self._serve(*await asyncio.open_connection(sock=client)))
                        serving.add(task)
                        task.add_done_callback(serving.discard)
            except OSError as error:
                self._log_change(meaning_of(error))
                await asyncio.sleep(self._times.retry_s)

    def _log_change(self, problem: str | None) -> None:
        if problem is None:
            log.info("metrics at http://%s%s", self._listen, _PATH)
        elif problem != self._problem:
            advice = "see listen in [metrics], and who else has the port: ss -tlnp"
            log.warning("no metrics at %s: %s; %s", self._listen, problem, advice)
        self._problem = problem

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        try:
            if self._connections <= TOGETHER:
                async with asyncio.timeout(self._times.request_s):
                    head = await reader.readuntil(b"\r\n\r\n")
                    writer.write(await self._answer(head.decode("latin-1")))
                    await writer.drain()
                    writer.close()
                    await writer.wait_closed()
        except (OSError, EOFError, asyncio.LimitOverrunError):
            log.debug("a request for metrics came to nothing")
        finally:
            self._connections -= 1
            writer.transport.abort()

    async def _answer(self, head: str) -> bytes:
        """Return the answer to a request with this head."""
        request = _REQUEST.match(head)
        if request is None:
            return _response("404 Not Found", [], f"not here; the metrics are at {_PATH}\n".encode())
        headers = Parser().parsestr(head.partition("\r\n")[2], headersonly=True)
        environ: dict[str, Any] = {
            "REQUEST_METHOD": request[1],
            "PATH_INFO": _PATH,
            "HTTP_ACCEPT": headers.get("Accept", ""),
            "HTTP_ACCEPT_ENCODING": headers.get("Accept-Encoding", ""),
        }
        started: dict[str, Any] = {}
        async with self._answering:
            self._collector.status = self._make()
            body = await asyncio.to_thread(self._app, environ, lambda *start: started.update(head=start))
            await asyncio.sleep(self._times.pause_s)
        status, headers = started["head"]
        return _response(status, headers, b"".join(body))


def _listening_socket(listen: Listen) -> socket.socket:
    family = socket.getaddrinfo(listen.host, listen.port, type=socket.SOCK_STREAM)[0][0]
    listening = socket.create_server((listen.host, listen.port), family=family, backlog=_BACKLOG)
    listening.setblocking(False)
    return listening


def _response(status: str, headers: list[tuple[str, str]], body: bytes) -> bytes:
    lines = [f"HTTP/1.0 {status}", f"Content-Length: {len(body)}", *(f"{name}: {value}" for name, value in headers)]
    return "\r\n".join([*lines, "", ""]).encode() + body
