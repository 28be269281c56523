"""Encrypted connections: who is let in, what is refused, and one line of log for each thing that is wrong."""

import asyncio
import socket
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import trustme
from brokers import Mosquitto
from mqtt_helpers import QUICK, password_line, said, until
from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import BrokerConnection
from resonator_daemon.mqtt.codec import Incoming
from resonator_daemon.mqtt.connecting import make_tls
from resonator_daemon.mqtt.packets import StreamPackets, pack
from resonator_daemon.mqtt.reconnection import keep_connected
from resonator_daemon.mqtt.requests import reach

TO_NOBODY = "anonymous"
QUICK_TLS = replace(QUICK, connect_s=5.0)
DAY = timedelta(days=1)
NOT_AUTHORIZED = b"\x20\x03\x00\x87\x00"


class Files:
    """Certificates of a broker on this computer, and of a client, by one authority; more of other kinds."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self.authority = trustme.CA()
        self.ca = self.write("ca.pem", self.authority.cert_pem)
        self.broker = self.pair("broker", self.authority.issue_cert("localhost"))
        self.client = self.pair("client", self.authority.issue_cert(common_name="left"))

    def write(self, name: str, *blobs: trustme.Blob | bytes) -> Path:
        path = self._directory / name
        path.write_bytes(b"".join(blob if isinstance(blob, bytes) else blob.bytes() for blob in blobs))
        return path

    def pair(self, name: str, made: trustme.LeafCert) -> tuple[Path, Path]:
        certificate = self.write(f"{name}.pem", *made.cert_chain_pems)
        key = self.write(f"{name}.key", made.private_key_pem)
        key.chmod(0o600)
        return certificate, key


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)


@asynccontextmanager
async def tls_mosquitto(
    directory: Path, files: Files, *settings: str, broker: tuple[Path, Path] | None = None
) -> AsyncIterator[Mosquitto]:
    certificate, key = broker or files.broker
    tls = (f"cafile {files.ca}", f"certfile {certificate}", f"keyfile {key}")
    async with Mosquitto(directory, *tls, *(settings or ("allow_anonymous true",))) as running:
        yield running


class Attempts:
    """What keeping a connection led to."""

    def __init__(self) -> None:
        self.made = 0  # attempts to connect, those included that only ask for the version
        self.served: list[BrokerConnection] = []
        self.heard: list[Incoming] = []

    @property
    def connected(self) -> bool:
        return any(client.connected for client in self.served)


@asynccontextmanager
async def keeping_connected(broker: Mqtt, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Attempts]:
    attempts = Attempts()
    create_connection = socket.create_connection

    def counted(*arguments: object, **options: object) -> socket.socket:
        attempts.made += 1
        return create_connection(*arguments, **options)  # type: ignore[arg-type]

    def make_connection(version: MQTTProtocolVersion) -> BrokerConnection:
        return BrokerConnection(broker, version, identifier="left", on_message=attempts.heard.append, times=QUICK_TLS)

    async def serve(connection: BrokerConnection) -> None:
        await connection.subscribe("echo/#", qos=1)
        attempts.served.append(connection)
        await asyncio.wait([connection.lost])

    closing = asyncio.get_running_loop().create_future()
    before = asyncio.all_tasks()
    with monkeypatch.context() as patch:
        patch.setattr(socket, "create_connection", counted)
        running = asyncio.create_task(keep_connected(broker, make_connection, serve, closing, times=QUICK_TLS))
        try:
            yield attempts
        finally:
            closing.set_result(None)
            await running
            unfinished = asyncio.all_tasks() - before  # an attempt that nobody waits for any more ends by itself
            if unfinished:
                await asyncio.wait(unfinished, timeout=5)


LoggedOnce = Callable[[Mqtt, str], Awaitable[None]]


@pytest.fixture
def logged_once(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> LoggedOnce:
    async def check(broker: Mqtt, finding: str) -> None:
        """Make several attempts, none of which succeeds and which lead to one line of log."""
        async with keeping_connected(broker, monkeypatch) as attempts:
            await until(lambda: attempts.made > 6)
            assert not attempts.served
        (line,) = caplog.messages
        assert line.startswith(f"broker {broker.host}:{broker.port}: ")
        assert finding in line

    return check


async def test_messages_and_streams_go_both_ways_through_tls(
    tmp_path: Path, files: Files, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    async with tls_mosquitto(tmp_path, files) as running:
        broker = Mqtt(url=running.tls_url, ca_file=str(files.ca))
        await reach(broker)
        async with keeping_connected(broker, monkeypatch) as attempts:
            await until(lambda: attempts.connected)
            client = attempts.served[0]
            payloads = [bytes([number]) * 100_000 for number in range(20)]
            for payload in payloads:
                await until(lambda: client.writable)
                client.send("echo/1", payload, qos=1)
            await until(lambda: len(attempts.heard) == len(payloads))
            assert [message.payload for message in attempts.heard] == payloads
            attempts.heard.clear()
            payloads = [bytes([number]) * (10_000 * number) for number in range(60)]  # far more than a socket holds
            stream = StreamPackets("echo/1", pack(), perishable=True)
            packets = [stream.packet(payload, is_mqtt_5=True) for payload in payloads]
            while packets:
                await until(lambda: client.writable)
                del packets[: client.send_streams(packets)[0]]
            await until(lambda: len(attempts.heard) == len(payloads))
            assert [message.payload for message in attempts.heard] == payloads
            assert client.messages_in_flight == 0
    assert said(caplog) == ["connected, MQTT 5"]


async def test_several_messages_in_one_record_all_arrive_at_once(files: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing more comes on the socket that could tell of those that wait in the decrypted part."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while packet := await reader.read(1000):
            if packet[0] == 0x10:
                writer.write(b"\x20\x03\x00\x00\x00")
            elif packet[0] == 0x82:
                acknowledged = b"\x90\x04" + packet[2:4] + b"\x00\x01"
                writer.write(acknowledged + b"".join(b"\x30\x0a\x00\x06echo/1\x00%d" % number for number in range(5)))
        writer.close()

    server_tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server_tls.load_cert_chain(*files.broker)
    async with await asyncio.start_server(serve, "127.0.0.1", 0, ssl=server_tls) as server:
        port = server.sockets[0].getsockname()[1]
        broker = Mqtt(url=f"mqtts://localhost:{port}", ca_file=str(files.ca))
        async with keeping_connected(broker, monkeypatch) as attempts:
            await until(lambda: len(attempts.heard) == 5)
    assert [message.payload for message in attempts.heard] == [b"0", b"1", b"2", b"3", b"4"]


def test_nothing_older_than_tls_1_2_and_no_unknown_host(files: Files) -> None:
    context = make_tls(Mqtt(url="mqtts://localhost", ca_file=str(files.ca)))
    assert context.minimum_version == ssl.TLSVersion.TLSv1_2
    assert context.verify_mode == ssl.CERT_REQUIRED
    assert context.check_hostname


TODAY = datetime.now(UTC)
BROKEN_BROKERS: dict[str, Callable[[trustme.CA], trustme.LeafCert]] = {
    "expired": lambda ca: ca.issue_cert("localhost", not_before=TODAY - 9 * DAY, not_after=TODAY - DAY),
    "not yet valid": lambda ca: ca.issue_cert("localhost", not_before=TODAY + DAY),
    "mismatch": lambda ca: ca.issue_cert("elsewhere.example"),
    "issuer": lambda _: trustme.CA().issue_cert("localhost"),
}


@pytest.mark.parametrize("finding", BROKEN_BROKERS)
async def test_an_invalid_certificate(finding: str, tmp_path: Path, files: Files, logged_once: LoggedOnce) -> None:
    made = files.pair("broken", BROKEN_BROKERS[finding](files.authority))
    async with tls_mosquitto(tmp_path, files, broker=made) as running:
        await logged_once(Mqtt(url=running.tls_url, ca_file=str(files.ca)), finding)


CLIENTS: dict[str, Callable[[trustme.CA], trustme.LeafCert] | None] = {
    "certificate required": None,
    "certificate expired": lambda ca: ca.issue_cert(
        common_name="left", not_before=TODAY - 9 * DAY, not_after=TODAY - DAY
    ),
    "unknown ca": lambda _: trustme.CA().issue_cert(common_name="left"),
}


@pytest.mark.parametrize("finding", CLIENTS)
async def test_a_client_certificate_that_is_missing_or_proves_nothing(
    finding: str, tmp_path: Path, files: Files, logged_once: LoggedOnce
) -> None:
    keys = {}
    if make := CLIENTS[finding]:
        certificate, key = files.pair("bad", make(files.authority))
        keys = {"certificate_file": str(certificate), "key_file": str(key)}
    async with tls_mosquitto(tmp_path, files, "require_certificate true", "allow_anonymous true") as running:
        broker = Mqtt(url=running.tls_url, ca_file=str(files.ca), **keys)
        await logged_once(broker, f"({finding}); see mqtt.certificate_file")


@pytest.mark.parametrize(("port", "finding"), [("tls_url", "see mqtt.ca_file"), ("url", "mqtt.url is mqtts://")])
async def test_the_log_names_the_setting_that_prevents_a_connection(
    port: str, finding: str, tmp_path: Path, files: Files, logged_once: LoggedOnce
) -> None:
    async with tls_mosquitto(tmp_path, files) as running:
        await logged_once(Mqtt(url=getattr(running, port)), finding)


async def test_tls_to_a_port_for_plain_mqtt(mosquitto: Mosquitto, files: Files, logged_once: LoggedOnce) -> None:
    await logged_once(Mqtt(url=mosquitto.tls_url, ca_file=str(files.ca)), "mqtt.url is mqtt://")


async def test_files_are_read_again_with_each_connection(
    tmp_path: Path, files: Files, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    passwords = files.write("passwords", password_line("robot", "new").encode())
    password = files.write("password", b"new")
    settings = ("require_certificate true", "allow_anonymous false", f"password_file {passwords}")
    async with tls_mosquitto(tmp_path, files, *settings) as running:
        broker = Mqtt(
            url=running.tls_url,
            ca_file=str(files.ca),
            certificate_file=str(files.client[0]),
            key_file=str(files.client[1]),
            username="robot",
            password_file=str(password),
        )
        password.write_bytes(b"old")
        async with keeping_connected(broker, monkeypatch) as attempts:
            await until(lambda: len(caplog.records) == 1)
            password.unlink()
            await until(lambda: len(caplog.records) == 2)
            password.write_bytes(b"new\r\n")
            await until(lambda: attempts.connected)
            certificate = files.client[0].read_bytes()
            files.client[0].write_bytes(files.broker[0].read_bytes())
            await running.kill()
            await running.start()
            await until(lambda: len(caplog.records) > 4)
            files.client[0].write_bytes(certificate)
            await until(lambda: attempts.connected)
    lines = [line for line in said(caplog) if "connection lost" not in line and "refused" not in line]
    findings = ("mqtt.password_file", "no such file", "connected", "is not the key of", "connected")
    assert [finding in line for finding, line in zip(findings, lines, strict=True)] == [True] * 5


@asynccontextmanager
async def greeted(answer: Callable[[int], bytes]) -> AsyncIterator[tuple[int, list[tuple[int, str]]]]:
    """Yields the port of a broker whose answer depends on the version of MQTT, and the versions and names it got."""
    record: list[tuple[int, str]] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not (packet := await reader.read(1000)):  # the attempt was given up before its CONNECT
            writer.close()
            return
        record.append((packet[8], "robot" if b"\x00\x05robot" in packet else TO_NOBODY))
        writer.write(answer(packet[8]))
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        yield server.sockets[0].getsockname()[1], record


@pytest.mark.parametrize("to_5", [b"\x20\x02\x00\x01", b"\x20\x03\x00\x84\x00"])
async def test_a_broker_that_speaks_neither_version(to_5: bytes, logged_once: LoggedOnce) -> None:
    async with greeted(lambda version: to_5 if version == 5 else b"\x20\x02\x00\x01") as (port, record):
        broker = Mqtt(url=f"mqtt://127.0.0.1:{port}")
        await logged_once(broker, "it supports neither MQTT 5 nor 3.1.1")
    assert {version for version, _ in record} == {4, 5}


async def test_a_refused_client_tries_no_name_once(logged_once: LoggedOnce, caplog: pytest.LogCaptureFixture) -> None:
    async with greeted(lambda _: NOT_AUTHORIZED) as (port, record):
        broker = Mqtt(url=f"mqtt://robot:sesame@127.0.0.1:{port}")
        await logged_once(broker, "'robot' (Not authorized); see mqtt.username, mqtt.password_file")
    assert "sesame" not in caplog.text
    assert [name for _, name in record[:5]] == [TO_NOBODY, "robot", "robot", "robot", "robot"]
