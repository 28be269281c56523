"""The metrics over HTTP, asked by a plain client."""

import asyncio
import contextlib
import errno
import gzip
import http.client
import logging
import os
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
import status_samples
from prometheus_client.parser import text_string_to_metric_families

from resonator_daemon.config import Listen
from resonator_daemon.monitoring import metrics_server
from resonator_daemon.monitoring.metrics_server import MetricsServer
from resonator_daemon.monitoring.status import Status

DEADLINE_S = 20.0


@pytest.fixture
def address() -> Listen:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return Listen("127.0.0.1", probe.getsockname()[1])


@asynccontextmanager
async def serving(address: Listen, collect: Callable[[], Status] = status_samples.status) -> AsyncIterator[None]:
    task = asyncio.create_task(MetricsServer(address, collect).run())
    try:
        async with asyncio.timeout(DEADLINE_S):
            yield
    finally:
        task.cancel()
        await asyncio.wait([task])


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


async def test_prometheus_gets_its_text(address: Listen) -> None:
    async with serving(address):
        response = await ask(address)
    assert response.status == 200
    assert response.headers["Content-Type"].startswith("text/plain; version=")
    names = {family.name for family in text_string_to_metric_families(response.body.decode())}
    assert {"resonatord_frames", "resonatord_link_up", "resonatord_latency_seconds"} <= names


async def test_each_request_finds_the_status_of_its_time_taken_on_the_loops_thread(address: Listen) -> None:
    asked_in = []

    def collect() -> Status:
        asked_in.append(threading.get_ident())
        return status_samples.status(health=status_samples.health(frames=1000 + len(asked_in)))

    async with serving(address, collect):
        bodies = [(await ask(address)).body.decode() for _ in range(3)]
    assert [f'resonatord_frames_total{{daemon="hand"}} {n}.0' in body for n, body in enumerate(bodies, 1001)] == [
        True
    ] * 3
    assert set(asked_in) == {threading.get_ident()}


async def test_packed_where_the_client_takes_it(address: Listen) -> None:
    async with serving(address):
        response = await ask(address, **{"Accept-Encoding": "gzip"})
    assert response.headers["Content-Encoding"] == "gzip"
    assert b"resonatord_link_up" in gzip.decompress(response.body)


async def test_nothing_can_be_done_to_the_daemon_this_way(address: Listen) -> None:
    async with serving(address):
        assert (await ask(address, method="POST")).status == 405


async def test_over_ipv6(address: Listen) -> None:
    if not socket.has_ipv6:
        pytest.skip("no IPv6 on this machine")
    address = Listen("::1", address.port)
    async with serving(address):
        assert (await ask(address)).status == 200


async def test_a_port_that_is_taken_is_said_once_and_served_when_it_is_free(
    address: Listen, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(metrics_server, "_AGAIN_S", 0.001)
    with socket.socket() as other:
        other.bind((address.host, address.port))
        other.listen()
        async with serving(address):
            while not caplog.records:  # noqa: ASYNC110 - the log has no event
                await asyncio.sleep(0.001)
            for _ in range(10):
                await asyncio.sleep(0.002)
            assert len(caplog.records) == 1
            other.close()
            assert (await ask(address)).status == 200
    assert [record.levelname for record in caplog.records] == ["WARNING", "INFO"]
    first, second = (record.getMessage() for record in caplog.records)
    assert first.startswith(f"no metrics at {address}: Address already in use; see listen in [metrics]")
    assert second == f"metrics at http://{address}/metrics"


async def test_clients_that_hang_or_leave_or_talk_nonsense_are_survived_in_silence(
    address: Listen, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(metrics_server, "_REQUEST_S", 0.2)
    async with serving(address):
        assert (await ask(address)).status == 200
        with (
            socket.create_connection((address.host, address.port)),
            socket.create_connection((address.host, address.port)) as half,
            socket.create_connection((address.host, address.port)) as other,
        ):
            half.sendall(b"GET /metrics HTTP/1.1\r\nHost: a")
            other.sendall(b"\x16\x03\x01\xff\xff\r\n\r\n")
            socket.create_connection((address.host, address.port)).close()
            assert (await ask(address)).status == 200
    assert capfd.readouterr() == ("", "")


async def test_idle_connections_keep_nobody_waiting(address: Listen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_server, "_REQUEST_S", 2 * DEADLINE_S)
    async with serving(address):
        assert (await ask(address)).status == 200
        idle = [socket.create_connection((address.host, address.port)) for _ in range(metrics_server._TOGETHER - 1)]
        assert (await ask(address)).status == 200
        for connection in idle:
            connection.close()


async def test_who_sends_a_byte_now_and_then_is_cut_off(address: Listen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_server, "_REQUEST_S", 0.1)
    monkeypatch.setattr(metrics_server, "_TOGETHER", 1)
    async with serving(address):
        assert (await ask(address)).status == 200
        _, dripping = await asyncio.open_connection(address.host, address.port)

        async def drip() -> None:
            with contextlib.suppress(ConnectionError):
                while True:
                    dripping.write(b"G")
                    await dripping.drain()
                    await asyncio.sleep(0.01)

        task = asyncio.create_task(drip())
        assert (await ask(address)).status == 200
        await task  # ends because it is cut off
        dripping.close()


async def test_connections_at_once_are_bounded(address: Listen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_server, "_PAUSE_S", 0.0)
    monkeypatch.setattr(metrics_server, "_REQUEST_S", 2 * DEADLINE_S)
    monkeypatch.setattr(metrics_server, "_TOGETHER", 3)
    stocks_taken = 0

    def collect() -> Status:
        nonlocal stocks_taken
        stocks_taken += 1
        return status_samples.status()

    async with serving(address, collect):
        assert (await ask(address)).status == 200
        idle = [socket.create_connection((address.host, address.port)) for _ in range(6)]
        while stocks_taken < 1 + 3:  # noqa: ASYNC110 - of another thread
            await asyncio.sleep(0.001)
        for _ in range(20):
            await asyncio.sleep(0.001)
        assert stocks_taken == 1 + 3
        for connection in idle:
            connection.close()
        assert (await ask(address)).status == 200


async def test_without_room_for_another_connection_it_is_said_and_tried_again(
    address: Listen, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics_server, "_AGAIN_S", 0.001)
    loop = asyncio.get_running_loop()
    accept, refusals = loop.sock_accept, iter(range(3))

    async def sock_accept(listening: socket.socket) -> tuple[socket.socket, object]:
        if next(refusals, None) is not None:
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return await accept(listening)

    monkeypatch.setattr(loop, "sock_accept", sock_accept)
    async with serving(address):
        assert (await ask(address)).status == 200
    assert "Too many open files" in caplog.text


async def test_the_port_is_free_afterwards(address: Listen) -> None:
    async with serving(address):
        assert (await ask(address)).status == 200
    with pytest.raises(ConnectionRefusedError):
        await asyncio.to_thread(request, address)


@pytest.mark.parametrize("path", ["/", "/x", "/metrics/", "/favicon.ico"])
async def test_any_other_path_is_refused_and_told_where_the_metrics_are(address: Listen, path: str) -> None:
    async with serving(address):
        response = await ask(address, path=path)
        assert (await ask(address, path="/metrics?name[]=resonatord_link_up")).status == 200
    assert response.status == 404
    assert response.body == b"not here; the metrics are at /metrics\n"
