"""A broker that dies, freezes, forgets or is slow: no event lost, all accounted for."""

import asyncio
import random
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from brokers import Amqtt, Mosquitto
from mqtt_helpers import EVENTS, IMPATIENT, LEFT, assert_exact, delivered, happen, outage, publishing, received_events
from observer import observe, until
from relay import relay
from sample_messages import Messages

from resonator_daemon.mqtt import event_log, outbox, topics

ONLINE = Messages.state("online", "all is well")


@pytest.fixture(params=["mosquitto", "amqtt"])
async def generous(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Mosquitto | Amqtt]:
    """A broker that drops nothing of what a subscriber has not taken yet; Mosquitto alone does so from 1000 on."""
    settings = ("allow_anonymous true", "max_queued_messages 0")
    async with Mosquitto(tmp_path, *settings) if request.param == "mosquitto" else Amqtt() as broker:
        yield broker


async def test_a_broker_that_is_killed_and_comes_back_empty(broker) -> None:
    async with publishing(broker.url) as left:
        left.publish(LEFT, topics.STATE_DAEMON, ONLINE)
        left.publish(LEFT, topics.STATE_LINK, Messages.state("starting"))
        await until(lambda: left.account.acknowledged == 2)
        await broker.kill()
        await until(lambda: not left.connected)
        left.publish(LEFT, topics.STATE_LINK, Messages.state("stalled"))
        left.publish(LEFT, topics.STATE_LINK, Messages.state("lost"))
        left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(1))
        left.publish(LEFT, topics.HEALTH, Messages.health(1))
        assert_exact(left)
        assert left.account.waiting == 2
        assert left.account.dropped == {"superseded": 1, "no_connection": 1}
        assert left.counts.missed == 1  # nobody misses the state that a newer one replaced
        await broker.start()
        async with observe(broker.url) as observer:
            await observer.until_last("resonator/left/state/daemon", state="online")
            await observer.until_last("resonator/left/state/link", state="lost")
            event = await observer.until_last(EVENTS, event="onset")
            await until(lambda: left.account.waiting == 0)
        assert event["replayed"]
        account = left.account
        assert (account.enqueued, account.republished, account.acknowledged) == (7, 1, 5)
        assert account.unknown_at_disconnect == 0


async def test_events_of_an_outage_come_in_order_with_their_times_and_a_mark(generous, tmp_path: Path) -> None:
    async with publishing(generous.url, spool_directory=tmp_path) as left:
        async with observe(generous.url) as observer:
            await until(lambda: left.connected)
            await happen(left, range(10))
            events = await received_events(observer, 9)
            assert not any(event["replayed"] for event in events)
        await outage(generous, left, range(10, 1000))
        await generous.start()
        async with observe(generous.url) as observer:
            events = await received_events(observer, 999)
            await until(lambda: left.account.waiting == 0)
            await happen(left, range(1000, 1010))
            events = await received_events(observer, 1009)
        seqs = [event["seq"] for event in events]
        assert seqs == list(range(seqs[0], 1010))
        assert {event["t_ns"] for event in events} == {str(Messages.event(0).t_ns)}
        assert [event["seq"] for event in events if not event["replayed"]] == list(range(1000, 1010))
        account = left.account
        assert (account.acknowledged, account.spooled, account.dropped) == (1010, 0, {})


@pytest.mark.parametrize("late", [200, 0])
async def test_events_wait_for_the_first_subscriber(mosquitto, tmp_path: Path, late: int) -> None:
    """The broker comes back without its store, and the daemon connects before any subscriber does."""
    async with publishing(mosquitto.url, spool_directory=tmp_path) as left:
        await until(lambda: left.connected)
        await outage(mosquitto, left, range(late))
        await mosquitto.start()
        await until(lambda: left.connected)
        for number in (late, late + 1):  # keep their places behind them
            left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
        await until(lambda: left.account.resent >= 2)  # two attempts
        events = await delivered(mosquitto.url, left, late + 1)
        assert [(event["seq"], event["replayed"]) for event in events] == [
            (n, n < max(late, 1)) for n in range(late + 2)
        ]


async def test_a_frozen_broker_stalls_nothing_and_all_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_log, "SUBSCRIBERS_S", 0.0)
    mosquitto = Mosquitto(tmp_path, "allow_anonymous true", "max_queued_messages 0")
    await mosquitto.start()
    async with publishing(mosquitto.url, spool_directory=tmp_path, times=IMPATIENT) as left:
        left.publish(LEFT, topics.STATE_DAEMON, ONLINE)
        left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(0))
        await until(lambda: left.account.acknowledged == 2)
        mosquitto.freeze()
        number = 1
        while left.connected or number < 1001:
            for _ in range(5):
                left.publish(LEFT, topics.DECODED, Messages.decoded(number))
                left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
                left.publish(LEFT, topics.HEALTH, Messages.health(number))
                assert_exact(left)
                number += 1
            await asyncio.sleep(0.001)
        frozen = left.account
        assert frozen.acknowledged == 2
        assert frozen.unknown_at_disconnect == outbox.UNACKNOWLEDGED_MAX + 1  # one stream was half written
        assert set(frozen.dropped) <= {"no_connection", "queue_full"}
        assert frozen.waiting == number - 1  # events alone, the first of which was acknowledged
        mosquitto.thaw()
        events = await delivered(mosquitto.url, left, number - 1)
        assert [event["seq"] for event in events] == list(range(events[0]["seq"], number))
        assert left.account.acknowledged == 1 + 1 + number  # the state once more, each event
        async with observe(mosquitto.url) as observer:  # the old connection's will did not have the last word
            await observer.until_last("resonator/left/state/daemon", state="online")
    await mosquitto.kill()


async def test_two_seconds_of_a_stalled_broker_cost_no_stream(mosquitto) -> None:
    async with observe(mosquitto.url) as observer, publishing(mosquitto.url) as left:
        await until(lambda: left.connected)
        mosquitto.freeze()
        for number in range(200):  # two seconds of arrays at 100 Hz, and of everything else at 400 Hz
            left.publish(LEFT, topics.DECODED, Messages.decoded(number))
            left.publish(LEFT, topics.SIGNALS, Messages.signals(number))
            for _ in range(4):
                left.publish(LEFT, topics.HEALTH, Messages.health(number))
            await asyncio.sleep(0)
        assert left.account.waiting > 100
        mosquitto.thaw()
        await observer.until(lambda: len(observer.messages) == 1200 + 2)
        assert left.account.dropped == {}


async def test_streams_that_waited_too_long_are_dropped_and_counted_as_late(mosquitto) -> None:
    async with (
        observe(mosquitto.url, f"{LEFT}/health") as observer,
        publishing(mosquitto.url, stream_wait_max_s=0.05) as left,
    ):
        await until(lambda: left.connected)
        mosquitto.freeze()
        number = 0
        while not left.account.dropped:  # first the sockets take what they hold
            left.publish(LEFT, topics.SIGNALS, Messages.signals(number))
            await asyncio.sleep(0.001)
            assert_exact(left)
            number += 1
        left.publish(LEFT, topics.HEALTH, Messages.health(1))
        late = left.account.dropped["late"]
        while left.account.dropped["late"] == late:  # what waits with the report is late as well
            left.publish(LEFT, topics.SIGNALS, Messages.signals(number))
            await asyncio.sleep(0.001)
        assert left.account.dropped.keys() == {"late"}
        assert left.counts.missed == 0  # no loss
        mosquitto.thaw()
        await observer.until_last(f"{LEFT}/health", seq=1)


async def test_accounts_are_exact_at_random_instants_while_connections_break(
    broker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_log, "SUBSCRIBERS_S", 0.0)
    chance = random.Random(20)
    async with relay(broker.url) as way, publishing(way.url, spool_directory=tmp_path) as left:
        left.publish(LEFT, topics.STATE_DAEMON, ONLINE)
        made = 1
        for number in range(4000):
            what = chance.random()
            if what < 0.70:
                left.publish(LEFT, topics.HEALTH, Messages.health(number))
            elif what < 0.97:
                left.publish(LEFT, topics.CONTACT_EVENT, Messages.event(number))
            else:
                left.publish(LEFT, topics.STATE_SENSOR, Messages.state("online", str(number)))
            made += 1
            if chance.random() < 0.05:
                await asyncio.sleep(0)
            if number % 2000 == 500:
                await until(lambda: left.connected)
            if number % 2000 == 1000:
                way.cut()
            account = left.account
            assert account.enqueued - account.republished - account.resent == made
            assert_exact(left)
        await until(lambda: left.account.waiting == 0)
    account = left.account
    assert account.acknowledged > 0
    assert account.written > 0
    assert account.dropped["no_connection"] > 0
    assert account.unknown_at_disconnect > 0
