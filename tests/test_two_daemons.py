"""Two daemons under one name: both report it and continue to measure, and one answers. Also a forged daemon."""

import json
import logging
from pathlib import Path

import pytest
from brokers import Amqtt, Mosquitto
from observer import Observer, observe
from service_bench import Bench

from resonator_daemon.mqtt import asyncapi, daemon_state

STATE = "resonator/hand/state/daemon"
OTHER = "another daemon (boot id {})"
SLOW = ("window_ms = 50", "step_ms = 50")  # two daemons, a broker and an observer of everything share this process


@pytest.fixture(autouse=True)
def _restored_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(daemon_state, "RESTORE_S", 2.0)


def said_by(observer: Observer, boot_id: str) -> str:
    """The reason that a daemon gave last."""
    mine = [state for state in observer.payloads(STATE) if state["daemon_boot_id"] == boot_id]
    return str(mine[-1]["reason"]) if mine else ""


def measured_by(observer: Observer, boot_id: str) -> int:
    return sum(forces["daemon_boot_id"] == boot_id for forces in observer.payloads("resonator/hand/forces"))


def commands_of(observer: Observer, boot_id: str) -> dict[str, int]:
    """What became of the commands to a daemon, by its last health."""
    mine = [health for health in observer.payloads("resonator/hand/health") if health["daemon_boot_id"] == boot_id]
    return dict(mine[-1]["commands"]) if mine else {}


async def test_both_report_it_until_one_has_gone(
    tmp_path: Path, broker: Mosquitto | Amqtt, caplog: pytest.LogCaptureFixture
) -> None:
    folders = [tmp_path / "one", tmp_path / "two"]
    for folder in folders:
        folder.mkdir()
    first, second = (Bench(folder, broker.url) for folder in folders)
    async with (
        first.emulated(scenario="still"),
        second.emulated(scenario="still"),
        observe(broker.url) as observer,
        first.running(first.service(measurement=SLOW)) as one,
    ):
        await observer.until_last(STATE, state="online", connections=1)
        async with second.running(second.service(measurement=SLOW)) as two:
            ids = one.daemon_boot_id, two.daemon_boot_id
            await observer.until(lambda: OTHER.format(ids[1]) in said_by(observer, ids[0]))
            await observer.until(lambda: OTHER.format(ids[0]) in said_by(observer, ids[1]))
            counts = [measured_by(observer, boot_id) for boot_id in ids]
            await observer.until(
                lambda: all(measured_by(observer, boot_id) > n for boot_id, n in zip(ids, counts, strict=True))
            )
            for asked in ({}, {"daemon_boot_id": "of nobody"}, {"daemon_boot_id": ids[1]}):
                await observer.client.publish("resonator/hand/cmd/events", json.dumps(asked), qos=1)
            await observer.until(
                lambda: commands_of(observer, ids[0]) == {"done": 1, "unknown_boot": 1, "unanswered": 1}
            )
            healths = observer.payloads("resonator/hand/health")  # neither displaces the other
            assert {health["messages"]["unknown_at_disconnect"] for health in healths} == {0}
            await observer.until(lambda: commands_of(observer, ids[1]) == {"done": 2, "storage_failed": 1})
            await observer.until_count("resonator/hand/rsp/events", 5)
            answers = [answer.get("daemon_boot_id") for answer in observer.payloads("resonator/hand/rsp/events")]
            assert sorted(answers, key=str) == sorted((*ids, ids[1], None, None), key=str)
        await observer.until(lambda: said_by(observer, ids[0]) == "measuring")
        await observer.until_last(STATE, daemon_boot_id=ids[0], state="online")  # after a will of the other, too
        for topic in ("info", "state/link", "state/sensor", "state/daemon"):
            full = f"resonator/hand/{topic}"
            await observer.until(lambda full=full: observer.payloads(full)[-1]["daemon_boot_id"] == ids[0])
        assert observer.payloads("resonator/hand/info")[-1]["link"] == f"serial:{first.port}?baud=4000000"
        states = len(observer.raw(STATE))
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    for boot_id in ids:  # a busy computer's changes are summed up
        assert sum(f"boot id {boot_id}) publishes under this name" in warning for warning in warnings) <= 1
    assert states <= 30  # neither answers the other without end


async def test_what_another_client_overwrites_is_restored(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    async with (
        bench.emulated(scenario="still"),
        observe(mosquitto.url) as observer,
        bench.running(bench.service(measurement=SLOW)) as daemon,
    ):
        await observer.until_last(STATE, state="online", reason_code="measuring")
        paths = ("state/link", "state/sensor", "info", "schema", "state/daemon")
        for path in paths:
            await observer.client.publish(f"resonator/hand/{path}", b"{}", qos=1, retain=True)
        for path in paths:
            topic = f"resonator/hand/{path}"
            await observer.until(lambda topic=topic: b"{}" in observer.raw(topic) and observer.raw(topic)[-1] != b"{}")
            async with observe(mosquitto.url, topic) as late:
                await late.until_count(topic, 1)
        for state in ("offline", "online") * 200:
            forged = {"daemon_boot_id": "forged", "state": state, "t_ns": "1", "reason_code": ""}
            await observer.client.publish(STATE, json.dumps(forged))
        await observer.until(lambda: sum(b"forged" in state for state in observer.raw(STATE)) == 400)
        await observer.until_last(STATE, daemon_boot_id=daemon.daemon_boot_id, reason_code="name_conflict")
        assert observer.raw("resonator/hand/schema")[:3] == [asyncapi.encoded(), b"{}", asyncapi.encoded()]
