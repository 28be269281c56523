"""Status of a daemon as metrics for Prometheus over HTTP; docs/how-to/monitor.md lists them.

Few connections at once, none for longer than a second, and 20 answers a second at most.
"""

import asyncio
import logging
import math
import re
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from email.parser import Parser
from itertools import accumulate
from typing import Any, Final, NamedTuple

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.board.config.tables import Listen
from resonator_daemon.daemon.monitoring.status import Status
from resonator_daemon.mqtt.message_account import Cause
from resonator_daemon.mqtt.payloads import Condition, Health, LatencyInfo, Lost

TOGETHER: Final = 8  # connections; further ones are closed
_BACKLOG: Final = 100
_PATH: Final = "/metrics"
_REQUEST: Final = re.compile(rf"GET {_PATH}(?:\?\S*)? HTTP/1\.[01]\r\n")
_WAITING: Final = "waiting"  # of bytes_by_outcome: goes up and down

log = logging.getLogger(__name__)

Value = float | Mapping[str, float] | None  # by the further label; None if unknown


class _Row(NamedTuple):
    """A metric: a counter if its name ends in _total."""

    name: str
    meaning: str
    value: Callable[[Any], Value]  # of the status, or of its health
    label: str = ""


_OF_STATUS: Final = (
    _Row("config_last_good", "1 while an earlier run's copy is used", lambda s: s.config.in_use == "last_good"),
    _Row("config_problems", "Why the present file is not in use", lambda s: len(s.config.problems)),
    _Row("config_needs_restart", "Changed keys that wait for a restart", lambda s: len(s.config.needs_restart)),
    _Row("config_load_time_seconds", "When the configuration in use was read", lambda s: s.config.loaded_t_ns * 1e-9),
    _Row("broker_connected", "1 while connected to the broker", lambda s: s.broker.connected),
    _Row("recording", "1 while a recording is being written", lambda s: bool(s.recording.file and not _failed(s))),
    _Row("recording_failed", "1 while a recording cannot be extended", lambda s: _failed(s)),
    _Row("recording_file_bytes", "Of the present file", lambda s: s.recording.file_bytes),
    _Row("recording_files_total", "Files that were begun", lambda s: s.recording.files),
    _Row("recording_files_removed_total", "Old recordings gone for the budget", lambda s: s.recording.files_removed),
    _Row("recording_missing_total", "What was recorded and is in no file", lambda s: _missing(s), "what"),
    _Row("link_up", "1 while frames of the board arrive", lambda s: bool(s.link and s.link.state is Condition.ONLINE)),
    _Row("board_boots_total", "Different boots of the board seen", lambda s: s.link and s.link.boot_count),
    _Row(
        "state_start_time_seconds",
        "Since when a part is as it is",
        lambda s: {part: state.since_t_ns * 1e-9 for part, state in _states(s).items() if state.since_t_ns is not None},
        "part",
    ),
    _Row("process_start_time_seconds", "Start of the daemon", lambda s: s.started_t_ns * 1e-9),
)
_OF_HEALTH: Final = (
    _Row("frames_total", "Frames that arrived", lambda h: h.frames),
    _Row("frames_lost_total", "Frames lost", lambda h: _frames_lost(h), "cause"),
    _Row("messages_late_total", "Messages not published, being late", lambda h: h.lost.skipped_late),
    _Row("frame_parts_lost_total", "Parts of frames lost", lambda h: h.parts_lost),
    _Row("frames_not_decoded_total", "Frames the decoder skipped", lambda h: h.frames_not_decoded),
    _Row("decoder_frames_skipped_total", "By the decoder", lambda h: h.decoder and h.decoder.skipped, "cause"),
    _Row("decoder_restarts_total", "Of the decoder process", lambda h: h.decoder and h.decoder.restarts, "cause"),
    _Row("decoder_cpu_ratio", "Processor time", lambda h: h.decoder and h.decoder.cpu_percent / 100),
    _Row("decoder_resident_memory_bytes", "Memory", lambda h: h.decoder and h.decoder.rss_mb * 1e6),
    _Row("sites_suspect", "Sites whose signals contradict those of all others", lambda h: h.sites_suspect),
    _Row("records_unusable_total", "Readings that gave no frequency", lambda h: h.records_unusable, "cause"),
    _Row("packets_ignored_total", "Packets that led to nothing", lambda h: h.packets_ignored, "cause"),
    _Row("link_bytes_total", "Bytes from the board by what became of them", lambda h: _bytes(h), "fate"),
    _Row("link_waiting_bytes", "Bytes of an incomplete packet", lambda h: h.bytes_by_outcome.get(_WAITING, 0)),
    _Row("link_connections_total", "Openings of the link", lambda h: h.connections),
    _Row("host_overruns_total", "Times the port's driver lost bytes", lambda h: h.host_overruns),
    _Row("clock_drift_ratio", "Rate of the board's clock against this one's", lambda h: _drift(h)),
    _Row("clock_outliers_total", "Pings that contradicted the others", lambda h: h.clock_outliers),
    _Row("clock_restarts_total", "Times the clock was estimated again", lambda h: h.clock_restarts),
    _Row("messages_enqueued_total", "Messages to publish", lambda h: h.messages.enqueued),
    _Row(
        "messages_sent_total",
        "Messages by what became of them",
        lambda h: h.messages.model_dump(include={"acknowledged", "written", "unknown_at_disconnect"}),
        "fate",
    ),
    _Row(
        "messages_repeated_total",
        "Of those: once more",
        lambda h: h.messages.model_dump(include={"republished", "resent", "recovered"}),
        "why",
    ),
    _Row("messages_dropped_total", "Messages never sent", lambda h: _dropped(h), "cause"),
    _Row("messages_waiting", "Messages not yet sent", lambda h: _messages_waiting(h), "where"),
    _Row("commands_total", "Commands by what became of them", lambda h: h.commands, "outcome"),
    # These are named as all clients of Prometheus do, and read without /proc, which the service's sandbox may hide.
    _Row("process_cpu_seconds_total", "Processor time, user and system", lambda h: time.process_time()),
    _Row("process_resident_memory_bytes", "Resident memory", lambda h: h.rss_mb * 1e6),
    _Row("process_open_fds", "File descriptors held open", lambda h: h.file_descriptors),
    _Row("threads", "Threads of the daemon", lambda h: h.threads),
    _Row("tasks", "Tasks of the daemon's event loop", lambda h: h.tasks),
)


class StatusCollector(Collector):
    """Makes metrics of a status; each has the label `daemon`, its instance. What is unknown is left out.

    Names have base units and `_total` where they only ever grow, by Prometheus' conventions.
    """

    def __init__(self, status: Status) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        status, health = self._status, self._status.health
        info = GaugeMetricFamily("resonatord_info", "1; its name and version", labels=["daemon", "name", "version"])
        info.add_metric([status.instance, status.name or "", status.version], 1)
        yield info
        state = GaugeMetricFamily(
            "resonatord_state", "1 for the present one of a part", labels=["daemon", "part", "state"]
        )
        for part, its in _states(status).items():
            for condition in Condition:
                state.add_metric([status.instance, part, condition.value], its.state is condition)
        yield state
        yield from self._families(_OF_STATUS, status)
        if health is not None:
            yield from self._families(_OF_HEALTH, health)
            meaning = "From the end of a window's last gate to the publisher"
            latency = HistogramMetricFamily("resonatord_latency_seconds", meaning, labels=["daemon", "topic"])
            for topic, histogram in health.latency.items():
                # The daemon does not add durations up, and a histogram without a sum may be published.
                latency.add_metric([status.instance, topic], _buckets(histogram), sum_value=None)
            yield latency

    def _families(self, rows: tuple[_Row, ...], part: Status | Health) -> Iterator[Metric]:
        for row in rows:
            value = row.value(part)
            if value is None:
                continue
            name = row.name if row.name.startswith("process_") else f"resonatord_{row.name}"
            kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
            family = kind(name, row.meaning, labels=["daemon", row.label] if row.label else ["daemon"])
            if isinstance(value, Mapping):
                for label, count in value.items():
                    family.add_metric([self._status.instance, label], count)
            else:
                family.add_metric([self._status.instance], float(value))
            yield family


def _failed(status: Status) -> bool:
    return status.recording.failure is not None


def _missing(status: Status) -> dict[str, int]:
    return {"events": status.recording.events_missing, "messages": status.recording.messages_missing}


def _states(status: Status) -> dict[str, Any]:
    states = {"daemon": status.daemon, "link": status.link, "sensor": status.sensor}
    return {part: state for part, state in states.items() if state is not None}


def _dropped(health: Health) -> dict[str, int]:
    return {cause.value: health.messages.dropped.get(cause, 0) for cause in Cause}


def _frames_lost(health: Health) -> dict[str, int]:
    causes = Lost.model_fields.keys() - {"publish_dropped", "skipped_late"}  # those are messages
    return {cause: getattr(health.lost, cause) for cause in sorted(causes)}


def _bytes(health: Health) -> dict[str, int]:
    return {fate: count for fate, count in health.bytes_by_outcome.items() if fate != _WAITING}


def _drift(health: Health) -> float | None:
    return health.clock_drift_ppm * 1e-6 if math.isfinite(health.clock_drift_ppm) else None


def _messages_waiting(health: Health) -> dict[str, int]:
    return {"memory": health.messages.waiting - health.messages.spooled, "disk": health.messages.spooled}


def _buckets(histogram: LatencyInfo) -> list[tuple[str, float]]:
    """Return upper bounds in s, and how many messages took no longer."""
    bounds = [str(bound_ms / 1e3) for bound_ms in histogram.bounds_ms]
    return list(zip([*bounds, "+Inf"], accumulate(histogram.counts), strict=True))


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
        if not _REQUEST.match(head):
            return _response("404 Not Found", "text/plain", f"not here; the metrics are at {_PATH}\n".encode())
        headers = Parser().parsestr(head.partition("\r\n")[2], headersonly=True)
        encode, content_type = choose_encoder(headers.get("Accept", ""))
        async with self._answering:
            body = await asyncio.to_thread(encode, StatusCollector(self._make()))
            await asyncio.sleep(self._times.pause_s)
        return _response("200 OK", content_type, body)


def _listening_socket(listen: Listen) -> socket.socket:
    family = socket.getaddrinfo(listen.host, listen.port, type=socket.SOCK_STREAM)[0][0]
    listening = socket.create_server((listen.host, listen.port), family=family, backlog=_BACKLOG)
    listening.setblocking(False)
    return listening


def _response(status: str, content_type: str, body: bytes) -> bytes:
    head = f"HTTP/1.0 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body
