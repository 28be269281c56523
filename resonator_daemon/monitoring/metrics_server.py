"""Metrics for Prometheus over HTTP: few connections, none for longer than a second, and 20 answers a second at most."""

import asyncio
import logging
import re
from collections.abc import Callable
from email.parser import Parser
from typing import Any, Final, NamedTuple

from prometheus_client import CollectorRegistry, make_wsgi_app

from resonator_daemon.config import Listen
from resonator_daemon.monitoring.metrics import StatusCollector
from resonator_daemon.monitoring.status import Status

TOGETHER: Final = 8  # connections; further ones are closed
_PATH: Final = "/metrics"
_REQUEST: Final = re.compile(rf"([A-Z]+) {_PATH}(?:\?\S*)? HTTP/1\.[01]\r\n")

log = logging.getLogger(__name__)


class MetricsTimes(NamedTuple):
    """Time limits and pauses of a metrics server, in seconds."""

    request_s: float = 1.0  # from the beginning of a connection to its end
    pause_s: float = 0.05  # after an answer
    retry_s: float = 5.0  # after a failure to listen


class MetricsServer:
    """Answers on an address as long as `run` does; a failure to listen is logged once and retried.

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

    async def run(self) -> None:
        """Answer until cancelled."""
        server = await self._begin_listening()
        log.info("metrics at http://%s%s", self._listen, _PATH)
        try:
            await server.serve_forever()
        finally:
            server.close()

    async def _begin_listening(self) -> asyncio.Server:
        problem = None
        while True:
            try:
                return await asyncio.start_server(self._serve, self._listen.host, self._listen.port)
            except OSError as error:
                if problem != (problem := error.strerror or str(error)):
                    advice = "see listen in [metrics], and who else has the port: ss -tlnp"
                    log.warning("no metrics at %s: %s; %s", self._listen, problem, advice)
            await asyncio.sleep(self._times.retry_s)

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


def _response(status: str, headers: list[tuple[str, str]], body: bytes) -> bytes:
    lines = [f"HTTP/1.0 {status}", f"Content-Length: {len(body)}", *(f"{name}: {value}" for name, value in headers)]
    return "\r\n".join([*lines, "", ""]).encode() + body
