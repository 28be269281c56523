"""A status as metrics: read back by the parsers of Prometheus' own client, and over HTTP by a plain client."""

import asyncio
import contextlib
import http.client
import json
import logging
import re
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import status_samples
from brokers import free_port
from observer import logged_once, running_task
from prometheus_client import generate_latest
from prometheus_client.openmetrics.exposition import generate_latest as generate_openmetrics
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families

from resonator_daemon.board.config.tables import Listen
from resonator_daemon.daemon.monitoring.metrics import TOGETHER, MetricsServer, MetricsTimes, StatusCollector
from resonator_daemon.daemon.monitoring.status import BrokerStatus, Status
from resonator_daemon.mqtt.payloads import Condition, Lost, MessageAccount

Key = tuple[str, frozenset[tuple[str, str]]]
DOCS = Path(__file__).parents[3] / "docs"


def text_of(status: Status) -> str:
    return generate_latest(StatusCollector(status)).decode()


def metrics(status: Status) -> dict[Key, float]:
    return samples_of(text_of(status), status.instance)


def samples_of(text: str, daemon: str) -> dict[Key, float]:
    """Return the samples by name and labels, the daemon's aside."""
    samples = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            assert sample.labels.pop("daemon") == daemon
            key = (sample.name, frozenset(sample.labels.items()))
            assert key not in samples
            samples[key] = sample.value
    return samples


def of(name: str, /, **labels: str) -> Key:
    return name, frozenset(labels.items())


def test_the_figures_of_a_status_are_metrics_in_base_units() -> None:
    expected = samples_of(Path(__file__).with_name("figures.prom").read_text(), "hand")
    found = metrics(status_samples.status())
    assert {key: found.get(key) for key in expected} == pytest.approx(expected, rel=1e-9)


def test_what_is_down_is_zero_and_not_left_out() -> None:
    down = status_samples.status(
        link=status_samples.state(Condition.LOST),
        broker=BrokerStatus(url="mqtt://b", connected=False),
        recording=status_samples.RECORDING.model_copy(update={"failure": "no room"}),
    )
    found = metrics(down)
    assert found[of("resonatord_link_up")] == found[of("resonatord_broker_connected")] == 0
    assert found[of("resonatord_recording")] == 0
    assert found[of("resonatord_recording_failed")] == 1
    assert metrics(status_samples.status(link=None))[of("resonatord_link_up")] == 0
    idle = metrics(status_samples.status(recording=status_samples.NOT_RECORDING.model_copy(update={"files": 5})))
    assert idle[of("resonatord_recording")] == idle[of("resonatord_recording_failed")] == 0
    assert idle[of("resonatord_recording_file_bytes")] == 0
    assert idle[of("resonatord_recording_files_total")] == 5
    assert idle[of("resonatord_recording_files_removed_total")] == 0
    assert {what for name, labels in idle if "recording_missing" in name for _, what in labels} == {
        "events",
        "messages",
    }


def test_each_cause_of_a_loss_is_a_counter_before_the_first_loss() -> None:
    status = status_samples.status()
    unharmed = status.health.model_copy(update={"lost": Lost(), "messages": MessageAccount()})
    found = metrics(status_samples.status(health=unharmed))
    lost = ["link_gap", "damaged", "board_overflow", "host_overrun", "queue_overflow"]
    assert [found[of("resonatord_frames_lost_total", cause=cause)] for cause in lost] == [0] * 5
    for cause in ("no_connection", "queue_full", "refused", "spool_full", "spool_failed"):
        assert found[of("resonatord_messages_dropped_total", cause=cause)] == 0


def test_the_strict_parser_of_openmetrics_takes_it_all() -> None:
    text = generate_openmetrics(StatusCollector(status_samples.status(name='a"b\\c\nd'))).decode()
    families = {family.name: family for family in parse_openmetrics(text)}
    assert families["resonatord_latency_seconds"].type == "histogram"
    assert families["resonatord_info"].samples[0].labels["name"] == 'a"b\\c\nd'


def named_in(text: str) -> set[str]:
    return set(re.findall(r"\b(?:resonatord|process)_[a-z_]+\b", text))


def there_are() -> set[str]:
    return {name for name, _ in metrics(status_samples.status())} | {"process_cpu_seconds_total"}


def test_every_metric_of_the_dashboard_exists() -> None:
    dashboard = json.loads((DOCS / "grafana" / "resonatord.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", ())]
    named = named_in("\n".join(queries) + json.dumps(dashboard["templating"]))
    assert len(named) > 20
    assert named <= there_are()


def test_the_page_lists_every_metric_and_no_other() -> None:
    page = (DOCS / "how-to" / "monitor.md").read_text()
    listed = set(re.findall(r"^- `((?:resonatord|process)_[a-z_]+)", page, re.MULTILINE))
    assert listed == there_are()
    assert named_in(page) - {"resonatord_latency_seconds"} <= there_are()
    alerts = named_in((DOCS / "grafana" / "alerts.yaml").read_text())
    assert len(alerts) > 5
    assert alerts <= there_are()


DEADLINE_S = 20.0


@pytest.fixture
def address() -> Listen:
    return Listen("127.0.0.1", free_port())


@asynccontextmanager
async def serving(
    address: Listen, make: Callable[[], Status] = status_samples.status, **times: float
) -> AsyncIterator[None]:
    async with running_task(MetricsServer(address, make, MetricsTimes(**times)).run()), asyncio.timeout(DEADLINE_S):
        yield


def request(address: Listen, method: str = "GET", path: str = "/metrics", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(address.host, address.port, timeout=DEADLINE_S)
    try:
        connection.request(method, path, headers=headers)
        response = connection.getresponse()
        response.body = response.read()  # type: ignore[attr-defined]
        return response
    finally:
        connection.close()


async def ask(address: Listen, **options: str) -> http.client.HTTPResponse:
    while True:
        try:
            return await asyncio.to_thread(request, address, **options)
        except (ConnectionRefusedError, ConnectionResetError):
            await asyncio.sleep(0.001)  # it is not up yet, or is just going down to come again


async def test_each_request_finds_the_status_of_its_time_taken_on_the_loops_thread(address: Listen) -> None:
    asked_in = []

    def make() -> Status:
        asked_in.append(threading.get_ident())
        return status_samples.status(health=status_samples.health(frames=1000 + len(asked_in)))

    async with serving(address, make):
        bodies = [(await ask(address)).body.decode() for _ in range(3)]
    assert all(f'resonatord_frames_total{{daemon="hand"}} {n}.0' in body for n, body in enumerate(bodies, 1001))
    assert set(asked_in) == {threading.get_ident()}


async def test_a_taken_port_is_logged_once_and_served_when_free(
    address: Listen, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with socket.create_server((address.host, address.port)) as other:
        async with serving(address, retry_s=0.001):
            assert "address already in use" in (await logged_once(caplog, 0.001)).lower()
            other.close()
            assert (await ask(address)).status == 200
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]
    assert caplog.messages[1] == f"metrics at http://{address}/metrics"


async def test_clients_that_send_no_request_are_not_logged(address: Listen, capfd: pytest.CaptureFixture[str]) -> None:
    async with serving(address):
        assert (await ask(address)).status == 200
        with socket.create_connection((address.host, address.port)) as other:
            other.sendall(b"\x16\x03\x01\xff\xff\r\n\r\n")
            socket.create_connection((address.host, address.port)).close()
            assert (await ask(address)).status == 200
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("sent", [b"", b"GET /metrics HTTP/1.1\r\nHost: a"])
async def test_a_request_that_is_not_complete_in_time_is_cut_off(address: Listen, sent: bytes) -> None:
    async with serving(address, request_s=0.2):
        assert (await ask(address)).status == 200
        reader, writer = await asyncio.open_connection(address.host, address.port)
        writer.write(sent)
        with contextlib.suppress(ConnectionError):
            assert await reader.read() == b""
        writer.close()


async def test_connections_at_once_are_bounded(address: Listen) -> None:
    async with serving(address, request_s=2 * DEADLINE_S):
        assert (await ask(address)).status == 200
        idle = [await asyncio.open_connection(address.host, address.port) for _ in range(TOGETHER - 1)]
        assert (await ask(address)).status == 200
        idle.append(await asyncio.open_connection(address.host, address.port))
        reader, further = await asyncio.open_connection(address.host, address.port)
        with contextlib.suppress(ConnectionError):
            assert await reader.read() == b""
        for _, writer in (*idle, (reader, further)):
            writer.close()
        assert (await ask(address)).status == 200
