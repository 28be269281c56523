"""Decoder processes on real brokers: one that follows a plate, many that share plates, and what they say."""

import asyncio
import functools
import json
import os
import signal
import sys
import threading
from asyncio.subprocess import DEVNULL
from contextlib import suppress
from pathlib import Path
from typing import Any

import cbor2
import pytest
from brokers import Amqtt, Mosquitto
from decoder_bench import Daemon, assert_exact, config_file, daemon, info, process, running, signals, until
from observer import Observer, observe

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.extensions.remote_decoding import followed_plates, plate, shared_plates
from resonator_daemon.extensions.remote_decoding import service as decode_service
from resonator_daemon.extensions.remote_decoding.service import CannotShareError, own_id
from resonator_daemon.mqtt.topics import DECODER_STATE

RESONATORD = Path(sys.executable).with_name("resonatord")
STATE = "resonator/decoder/host-1/state"
NO_INFO = "hand: no info yet: no daemon has published under this name"
SHARING = 'plates = ["+"]\ngroup = "touch"\ncontact_physics = false'
LINEAR = "contact_physics = false"


def seqs(observer: Observer, plate: str, path: str = "decoded") -> list[int]:
    return [cbor2.loads(payload)["seq"] for payload in observer.raw(f"resonator/{plate}/{path}")]


async def send_until_decoded(hand: Daemon, observer: Observer, seq: int) -> None:
    """Send a frame more than once where it came too late: its decoder was being set up, or the computer is busy."""
    while seq not in seqs(observer, "hand"):
        await hand.send("hand", signals(seq))
        with suppress(TimeoutError):
            async with asyncio.timeout(0.2):
                await observer.until(lambda: seq in seqs(observer, "hand"))


async def test_a_followed_plate_is_decoded_and_its_states_and_account_are_reported(
    tmp_path: Path, broker: Mosquitto | Amqtt, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(followed_plates, "CONTACTS_END_S", 3600.0)  # else a slow computer releases the contact
    monkeypatch.setattr(plate, "WAITS_AFTER_S", 3600.0)
    async with observe(broker.url) as observer, daemon(broker.url) as hand:
        decoder = process(tmp_path, broker.url, decoding=LINEAR)
        async with running(decoder):
            await observer.until_last(STATE, state="waiting", reason=NO_INFO)
            await hand.send_info("hand", info())
            await observer.until_last(STATE, state="waiting", reason="hand: no signals that could be decoded")
            for seq in range(5):
                await send_until_decoded(hand, observer, seq)
            await observer.until_last(STATE, state="online", reason="signals of hand are decoded")
            await hand.send_raw("hand", b"garbage")
            await until(lambda: decoder.health().plates["hand"].unusable == 1)
            assert_exact(decoder)
        last = await observer.until_last(STATE, state="offline", reason="stopped")
        events = observer.payloads("resonator/hand/contacts/event")  # before the state
        assert [event["event"] for event in events] == ["onset", "release"]
        assert last["decoder_id"] == "host-1"
        assert last["topic_filter"] == "resonator/hand/signals"
        healths = functools.partial(observer.payloads, "resonator/decoder/host-1/health")
        await observer.until(lambda: healths()[-1]["plates"]["hand"]["unusable"] == 1)  # comes after the state
        health = healths()[-1]
        account = health["plates"]["hand"]
        assert account["received"] == account["decoded"] + account["skipped"] + 1
        assert (account["unusable"], account["waiting"], account["missed"]) == (1, 0, 0)
        assert health["messages"]["enqueued"] > 15
        assert sum(health["latency"]["decoded"]["counts"]) == account["decoded"] >= 5
    assert sorted(set(seqs(observer, "hand"))) == [0, 1, 2, 3, 4]
    summaries = observer.payloads("resonator/hand/decoded/summary")
    assert {summary["decoder_id"] for summary in summaries} == {"host-1"}


async def test_two_that_follow_one_plate_report_each_other_until_one_has_gone(
    tmp_path: Path, broker: Mosquitto | Amqtt, caplog: pytest.LogCaptureFixture
) -> None:
    def remarks(of: str, rival: str, plates: str) -> bool:
        (*_, state) = observer.payloads(f"resonator/decoder/{of}/state") or [{"reason": ""}]
        return f"decoder {rival} follows {plates}, too" in state["reason"]

    async with observe(broker.url) as observer, running(process(tmp_path, broker.url)):
        await observer.until_last(STATE, state="waiting", reason=NO_INFO)
        several = process(tmp_path, broker.url, "host-2", decoding='plates = ["foot", "hand"]', name=None)
        async with running(several):
            await observer.until(lambda: remarks("host-1", "host-2", "this plate"))
            await observer.until(lambda: remarks("host-2", "host-1", "some of these plates"))
        await observer.until_last(STATE, state="waiting", reason=NO_INFO)
    assert sum("host-2 follows this plate" in line for line in caplog.messages) == 1


async def test_frames_of_many_plates_are_shared_and_none_is_decoded_twice(tmp_path: Path, mosquitto: Mosquitto) -> None:
    plates, frames = ("left", "right"), 40
    async with observe(mosquitto.url) as observer, daemon(mosquitto.url) as hand:
        for plate in plates:
            await hand.send_info(plate, info())
        decoders = [
            process(tmp_path, mosquitto.url, f"host-{number}", decoding=SHARING, name=None) for number in (1, 2)
        ]
        async with running(decoders[0]), running(decoders[1]):
            await until(lambda: all(set(decoder.health().plates) == set(plates) for decoder in decoders))
            for seq in range(frames):
                for plate in plates:
                    await hand.send(plate, signals(seq))
                    # One at a time, so that nothing needs to be skipped.
                    await until(
                        lambda plate=plate, seq=seq: sum(d.health().plates[plate].decoded for d in decoders) > seq
                    )
            await observer.until(lambda: all(len(seqs(observer, plate)) == frames for plate in plates))
            for decoder in decoders:
                assert_exact(decoder)
                assert sum(plate.received for plate in decoder.health().plates.values()) > 0
    for plate in plates:
        assert sorted(seqs(observer, plate)) == list(range(frames))
        summaries = observer.payloads(f"resonator/{plate}/decoded/summary")
        assert {summary["decoder_id"] for summary in summaries} <= {"host-1", "host-2"}
        assert {patch["id"] for summary in summaries for patch in summary["patches"]} == {None}
        assert any(summary["patches"] for summary in summaries)
        assert observer.raw(f"resonator/{plate}/contacts/event") == []
        contacts = observer.payloads(f"resonator/{plate}/contacts")
        assert {contact["id"] for message in contacts for contact in message["contacts"]} == {None}


async def test_the_will_of_a_decoder_that_is_killed_is_its_state(tmp_path: Path, mosquitto: Mosquitto) -> None:
    path = config_file(tmp_path, mosquitto.url, decoding=SHARING, name=None)
    victim = await asyncio.create_subprocess_exec(RESONATORD, "decode", "--config", path, stderr=DEVNULL)
    try:
        async with observe(mosquitto.url, "resonator/decoder/+/state") as observer:
            await observer.until(lambda: bool(observer.messages))
            os.kill(victim.pid, signal.SIGKILL)
            await observer.until_last(observer.messages[0].topic.value, state="offline", reason="connection lost")
        async with observe(mosquitto.url) as late:
            await late.until_last(observer.messages[0].topic.value, state="offline", reason="connection lost")
    finally:
        if victim.returncode is None:
            with suppress(ProcessLookupError):
                victim.kill()
        await victim.wait()


async def test_a_broker_that_cannot_share_is_refused_with_one_sentence(tmp_path: Path, amqtt: Amqtt) -> None:
    decoder = process(tmp_path, amqtt.url, decoding=SHARING, name=None)
    with pytest.raises(CannotShareError) as raised:
        await asyncio.wait_for(decoder.run(), 30)
    assert raised.value.exit_code is ExitCode.UNAVAILABLE
    assert len(raised.value.messages) == 1
    assert "\n" not in raised.value.messages[0]


@pytest.mark.parametrize("restarted", [False, True])
async def test_an_event_of_an_outage_arrives_after_it(
    restarted: bool, tmp_path: Path, mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(followed_plates, "CONTACTS_END_S", 3600.0)
    events = "resonator/hand/contacts/event"
    decoder = process(tmp_path, mosquitto.url, decoding=LINEAR)
    async with running(decoder):
        async with observe(mosquitto.url) as observer, daemon(mosquitto.url) as hand:
            await hand.send_info("hand", info())
            await observer.until_last(STATE, state="waiting", reason="hand: no signals that could be decoded")
            for seq in range(3):
                await send_until_decoded(hand, observer, seq)
            (onset,) = [json.loads(payload) for payload in await observer.until_count(events, 1)]
        await mosquitto.kill()
        await until(lambda: decoder.health().messages.dropped.get("no_connection", 0) > 0)
        monkeypatch.setattr(followed_plates, "CONTACTS_END_S", 0.0)
        await until(lambda: decoder.health().messages.spooled == 1)
        if not restarted:
            await mosquitto.start()
            async with observe(mosquitto.url) as again:
                await again.until_count(events, 1)
    if restarted:
        await mosquitto.start()
        async with (
            observe(mosquitto.url) as again,
            running(process(tmp_path, mosquitto.url, "host-2", decoding=LINEAR)),
        ):
            await again.until_count(events, 1)
    release = again.payloads(events)[0]
    assert [(event["event"], event["replayed"]) for event in (onset, release)] == [("onset", False), ("release", True)]
    assert [(event["decoder_id"], event["seq"]) for event in (onset, release)] == [("host-1", 0), ("host-1", 1)]
    assert release["contact"]["id"] == onset["contact"]["id"]


async def test_a_stop_during_a_set_up_is_reported_before_that_has_ended(
    tmp_path: Path, mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    began, may_end = threading.Event(), threading.Event()

    def slow(*_: object) -> None:
        began.set()
        assert may_end.wait(60)
        raise ValueError("too late")

    monkeypatch.setattr(shared_plates, "set_up", slow)
    decoder = process(tmp_path, mosquitto.url, decoding=SHARING, name=None)
    async with observe(mosquitto.url) as observer, daemon(mosquitto.url) as hand:

        def accounts() -> list[Any]:
            told = (health["plates"] for health in observer.payloads("resonator/decoder/host-1/health"))
            return [plates["hand"] for plates in told if "hand" in plates]

        task = asyncio.create_task(decoder.run())
        try:
            await hand.send_info("hand", info())
            await until(lambda: bool(observer.raw(STATE)) and "no info" not in observer.payloads(STATE)[-1]["reason"])
            await until(lambda: "hand" in decoder.health().plates)
            while not began.is_set():
                await hand.send("hand", signals(0))
                await asyncio.sleep(0.02)
            decoder.stop()
            await observer.until_last(STATE, state="offline", reason="stopped")
            assert not task.done()
            await observer.until(lambda: accounts() != [] and accounts()[-1]["waiting"] == 0)
            account = accounts()[-1]
            assert account["received"] == account["skipped"] + account["unusable"] > 0
            assert not task.done()
        finally:
            may_end.set()
            await task


async def test_a_state_lasts_while_its_reason_changes_and_is_reported_again_before_it_expires(
    tmp_path: Path, mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert DECODER_STATE.expiry_s is not None
    assert DECODER_STATE.expiry_s / 2 > decode_service.STATE_AGAIN_S
    monkeypatch.setattr(decode_service, "STATE_AGAIN_S", 0.2)
    decoder = process(tmp_path, mosquitto.url, decoding=LINEAR)
    async with observe(mosquitto.url) as observer, daemon(mosquitto.url) as hand, running(decoder):
        await observer.until(lambda: [state["reason"] for state in observer.payloads(STATE)].count(NO_INFO) >= 3)
        await hand.send_info("hand", info())
        await observer.until_last(STATE, state="waiting", reason="hand: no signals that could be decoded")
        await send_until_decoded(hand, observer, 0)
        await observer.until_last(STATE, state="online")
    told = observer.payloads(STATE)
    since = {word: {state["since_t_ns"] for state in told if state["state"] == word} for word in ("waiting", "online")}
    assert [len(times) for times in since.values()] == [1, 1]
    assert int(*since["waiting"]) < int(*since["online"])
    assert len({state["t_ns"] for state in told}) == len(told)


def test_its_id_is_one_level_of_a_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "$a/b+c#d e\x00" + "x" * 200)
    name = own_id()
    assert f"-{os.getpid()}-" in name
    assert own_id() != name  # process ids come again
    assert not set(name) & set("/+# \0$")
    assert len(name) < 100
