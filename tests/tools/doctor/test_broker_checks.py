"""Brokers that are well, refuse, are not there, are slow, or wait for acknowledgements."""

import socket
from pathlib import Path

import pytest
from brokers import Mosquitto
from relay import relay

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import ConnectionTimes
from resonator_daemon.tools.doctor import broker_checks
from resonator_daemon.tools.doctor.broker_checks import check_broker
from resonator_daemon.tools.doctor.finding import Finding, Outcome
from resonator_daemon.tools.doctor.host_checks import Host

HOST = Host(Path("/none"))  # which tells of no load
HALTED = "this computer is busy"
ATTEMPTS = 20


async def found(url: str, times: ConnectionTimes | None = None) -> dict[str, Finding]:
    for _ in range(ATTEMPTS):
        findings = await check_broker(Mqtt(url=url), HOST, times)
        if not any(finding.evidence.startswith(HALTED) for finding in findings):
            break
    return {finding.id: finding for finding in findings}


async def test_a_broker_that_is_well(mosquitto: Mosquitto) -> None:
    findings = await found(mosquitto.url)
    assert {finding.outcome for finding in findings.values()} == {Outcome.OK}
    assert findings["broker.accepts"].evidence == "MQTT 5"


async def test_a_broker_without_nodelay_shows_spikes(tmp_path: Path) -> None:
    async with Mosquitto(tmp_path, "set_tcp_nodelay false", "allow_anonymous true") as broker:
        # On a busy computer a broker may come to read both messages of a pair at once, and sends them in one.
        for _ in range(20):
            finding = (await found(broker.url))["broker.round_trip"]
            if finding.outcome is Outcome.WARNING:
                break
    assert finding.outcome is Outcome.WARNING


async def test_a_broker_that_refuses_says_whom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker_checks, "ACCEPT_S", 1.0)
    async with Mosquitto(tmp_path, "allow_anonymous false") as broker:
        findings = await found(broker.url)
    assert findings["broker.listens"].outcome is Outcome.OK
    assert findings["broker.accepts"].outcome is Outcome.FAULT
    assert "a client without a name" in findings["broker.accepts"].evidence


@pytest.mark.parametrize("url", ["mqtt://127.0.0.1:9", "mqtt://no-such-host.invalid:1883"])
async def test_a_broker_that_is_not_there_is_a_fault(url: str) -> None:
    findings = await found(url)
    assert [name for name, finding in findings.items() if finding.outcome is Outcome.FAULT] == ["broker.listens"]
    assert findings["broker.round_trip"].outcome is Outcome.NOT_CHECKED


async def test_a_way_that_is_too_narrow_is_told(mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker_checks, "ANSWER_S", 0.2)
    async with relay(mosquitto.url) as narrow:
        narrow.bytes_per_s = 1000.0
        finding = (await found(narrow.url))["broker.round_trip"]
    assert finding.outcome in (Outcome.FAULT, Outcome.WARNING)


async def test_who_takes_connections_and_says_nothing_is_no_matter_of_accounts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(broker_checks, "ACCEPT_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        findings = await found(f"mqtt://127.0.0.1:{silent.getsockname()[1]}", times=ConnectionTimes(connect_s=0.1))
    assert findings["broker.accepts"].outcome is Outcome.FAULT
    assert "accepts connections and does not answer as an MQTT broker" in findings["broker.accepts"].evidence
    assert "mqtt.url" in findings["broker.accepts"].remedy
    assert "account" not in findings["broker.accepts"].remedy
