"""The metrics over HTTP, asked by a plain client."""

import asyncio
import contextlib
import http.client
import logging
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
import status_samples
from brokers import free_port
from observer import running_task

from resonator_daemon.board.config.tables import Listen
from resonator_daemon.daemon.monitoring.metrics import TOGETHER, MetricsServer, MetricsTimes
from resonator_daemon.daemon.monitoring.status import Status

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
    assert [f'resonatord_frames_total{{daemon="hand"}} {n}.0' in body for n, body in enumerate(bodies, 1001)] == [
        True
    ] * 3
    assert set(asked_in) == {threading.get_ident()}


async def test_a_port_that_is_taken_is_logged_once_and_served_when_it_is_free(
    address: Listen, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with socket.socket() as other:
        other.bind((address.host, address.port))
        other.listen()
        async with serving(address, retry_s=0.001):
            while not caplog.records:  # noqa: ASYNC110 - the log has no event
                await asyncio.sleep(0.001)
            for _ in range(10):
                await asyncio.sleep(0.002)
            assert len(caplog.records) == 1
            other.close()
            assert (await ask(address)).status == 200
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]
    assert "address already in use" in caplog.messages[0].lower()
    assert caplog.messages[1] == f"metrics at http://{address}/metrics"


async def test_clients_that_leave_or_send_no_request_are_survived_in_silence(
    address: Listen, capfd: pytest.CaptureFixture[str]
) -> None:
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
