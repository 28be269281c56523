"""Decoder processes on real brokers: one that follows a plate, many that share plates, and what they say."""

import asyncio
import functools
import json
import os
import signal
import sys
from asyncio.subprocess import DEVNULL
from contextlib import suppress
from pathlib import Path

import cbor2
import pytest
from brokers import Amqtt, Mosquitto
from decoder_bench import Daemon, assert_exact, config_file, daemon, info, process, running, signals, until
from observer import Observer, observe

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.extensions.remote_decoding import plate
from resonator_daemon.extensions.remote_decoding import service as decode_service
from resonator_daemon.extensions.remote_decoding.service import CannotShareError, own_id
from resonator_daemon.mqtt.topics import DECODER_STATE

RESONATORD = Path(sys.executable).with_name("resonatord")
STATE = "resonator/decoder/host-1/state"
NO_INFO = "no info yet: no daemon has published under this name"


def seqs(observer: Observer, plate: str, path: str = "decoded") -> list[int]:
    return [cbor2.loads(payload)["seq"] for payload in observer.raw(f"resonator/{plate}/{path}")]


async def send_until_decoded(hand: Daemon, observer: Observer, seq: int, plate: str = "hand") -> None:
    """Send a frame more than once where it came too late: its decoder was being set up, or the computer is busy."""
    while seq not in seqs(observer, plate):
        await hand.send(plate, signals(seq))
        with suppress(TimeoutError):
            async with asyncio.timeout(0.2):
                await observer.until(lambda: seq in seqs(observer, plate))


async def test_a_followed_plate_is_decoded_and_its_states_and_account_are_reported(
    tmp_path: Path, broker: Mosquitto | Amqtt, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plate, "CONTACTS_END_S", 3600.0)  # else a slow computer releases the contact
    monkeypatch.setattr(plate, "WAITS_AFTER_S", 3600.0)
    async with observe(broker.url) as observer, daemon(broker.url) as hand:
        decoder = process(tmp_path, broker.url)
        async with running(decoder):
            await observer.until_last(STATE, state="waiting", reason=NO_INFO)
            await hand.send_info("hand", info())
            await observer.until_last(STATE, state="waiting", reason="no signals that could be decoded")
            for seq in range(5):
                await send_until_decoded(hand, observer, seq)
            await observer.until_last(STATE, state="online", reason="signals are decoded")
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


async def test_one_process_follows_several_plates(tmp_path: Path, mosquitto: Mosquitto) -> None:
    async with observe(mosquitto.url) as observer, daemon(mosquitto.url) as hand:
        decoder = process(tmp_path, mosquitto.url, decoding='plates = ["left", "right"]')
        async with running(decoder):
            for name in ("left", "right"):
                await hand.send_info(name, info())
            for name, seq in (("left", 1), ("right", 2)):
                await send_until_decoded(hand, observer, seq, name)
            await observer.until_last(STATE, state="online", reason_code="decoding")
            assert_exact(decoder)
    assert (set(seqs(observer, "left")), set(seqs(observer, "right"))) == ({1}, {2})


async def test_frames_are_shared_by_a_group_and_none_is_decoded_twice(tmp_path: Path, mosquitto: Mosquitto) -> None:
    sharing = 'plates = ["hand"]\ngroup = "touch"'
    async with observe(mosquitto.url) as observer, daemon(mosquitto.url) as hand:
        await hand.send_info("hand", info())
        decoders = [process(tmp_path, mosquitto.url, f"host-{number}", decoding=sharing) for number in (1, 2)]
        async with running(decoders[0]), running(decoders[1]):
            for number in (1, 2):
                state = f"resonator/decoder/host-{number}/state"
                await observer.until_last(state, reason_code="no_signals")
            accounts = [lambda it=it: it.health().plates["hand"] for it in decoders]
            seq = 0

            def found_patches() -> set[str]:
                summaries = observer.payloads("resonator/hand/decoded/summary")
                return {summary["decoder_id"] for summary in summaries if summary["patches"]}

            while found_patches() != {"host-1", "host-2"}:
                await hand.send("hand", signals(seq := seq + 1))
                await until(lambda seq=seq: sum(account().received for account in accounts) == seq)
                await until(lambda: not any(account().waiting for account in accounts))
            for decoder in decoders:
                assert_exact(decoder)
            decoded = sum(account().decoded for account in accounts)
            await observer.until(lambda: len(seqs(observer, "hand")) == decoded)
    assert len(set(seqs(observer, "hand"))) == decoded
    summaries = observer.payloads("resonator/hand/decoded/summary")
    assert {patch["id"] for summary in summaries for patch in summary["patches"]} == {None}
    assert not observer.raw("resonator/hand/contacts") + observer.raw("resonator/hand/contacts/event")


async def test_a_broker_that_cannot_share_is_refused(tmp_path: Path, amqtt: Amqtt) -> None:
    decoder = process(tmp_path, amqtt.url, decoding='plates = ["hand"]\ngroup = "touch"')
    with pytest.raises(CannotShareError) as raised:
        await asyncio.wait_for(decoder.run(), 30)
    assert raised.value.exit_code is ExitCode.UNAVAILABLE


async def test_the_will_of_a_decoder_that_is_killed_is_its_state(tmp_path: Path, mosquitto: Mosquitto) -> None:
    path = config_file(tmp_path, mosquitto.url)
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


@pytest.mark.parametrize("restarted", [False, True])
async def test_an_event_of_an_outage_arrives_after_it(
    restarted: bool, tmp_path: Path, mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plate, "CONTACTS_END_S", 3600.0)
    events = "resonator/hand/contacts/event"
    decoder = process(tmp_path, mosquitto.url)
    async with running(decoder):
        async with observe(mosquitto.url) as observer, daemon(mosquitto.url) as hand:
            await hand.send_info("hand", info())
            await observer.until_last(STATE, state="waiting", reason="no signals that could be decoded")
            for seq in range(3):
                await send_until_decoded(hand, observer, seq)
            (onset,) = [json.loads(payload) for payload in await observer.until_count(events, 1)]
        await mosquitto.kill()
        await until(lambda: decoder.health().messages.dropped.get("no_connection", 0) > 0)
        monkeypatch.setattr(plate, "CONTACTS_END_S", 0.0)
        await until(lambda: decoder.health().messages.spooled == 1)
        if not restarted:
            await mosquitto.start()
            async with observe(mosquitto.url) as again:
                await again.until_count(events, 1)
    if restarted:
        await mosquitto.start()
        async with observe(mosquitto.url) as again, running(process(tmp_path, mosquitto.url, "host-2")):
            await again.until_count(events, 1)
    release = again.payloads(events)[0]
    assert [(event["event"], event["replayed"]) for event in (onset, release)] == [("onset", False), ("release", True)]
    assert [(event["decoder_id"], event["seq"]) for event in (onset, release)] == [("host-1", 0), ("host-1", 1)]
    assert release["contact"]["id"] == onset["contact"]["id"]


async def test_a_state_lasts_while_its_reason_changes_and_is_reported_again_before_it_expires(
    tmp_path: Path, mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert DECODER_STATE.expiry_s is not None
    assert DECODER_STATE.expiry_s / 2 > decode_service.STATE_AGAIN_S
    monkeypatch.setattr(decode_service, "STATE_AGAIN_S", 0.2)
    decoder = process(tmp_path, mosquitto.url)
    async with observe(mosquitto.url) as observer, daemon(mosquitto.url) as hand, running(decoder):
        await observer.until(lambda: [state["reason"] for state in observer.payloads(STATE)].count(NO_INFO) >= 3)
        await hand.send_info("hand", info())
        await observer.until_last(STATE, state="waiting", reason="no signals that could be decoded")
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
