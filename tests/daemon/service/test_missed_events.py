"""A client that was away asks the daemon for the events that it missed, of this run and of the one before."""

from typing import Any

from brokers import Mosquitto
from observer import observe
from scenarios import IDEAL, touch_text
from service_bench import Bench, events

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.requests import request

TOUCHES = "period_s = 0.5\n" + IDEAL + touch_text(0.1, 1.0, 0.2, site=7)


async def missed(bench: Bench, **payload: Any) -> dict[str, Any]:
    answer = await request(Mqtt(url=bench.broker_url), "hand", "events", payload)
    assert answer["ok"], answer
    return answer


def as_published(event: dict[str, Any]) -> dict[str, Any]:
    return event | {"replayed": False}


async def test_a_client_closes_its_gap(bench: Bench, mosquitto: Mosquitto) -> None:
    async with bench.emulated(scenario=bench.scenario(TOUCHES)), observe(mosquitto.url) as other:
        async with bench.running(bench.service()) as first:
            async with observe(mosquitto.url) as client:
                await client.until(lambda: len(events(client)) >= 2)
                have = events(client)
            await other.until(lambda: len(events(other)) >= len(have) + 4)
            answer = await missed(bench, after_seq=have[-1]["seq"])
            assert (answer["complete"], answer["oldest_seq"]) == (True, 0)
            seen = [*have, *map(as_published, answer["events"])]
            await other.until(lambda: len(events(other)) >= len(seen))
            assert seen == events(other)[: len(seen)]
            assert [event["seq"] for event in seen] == list(range(answer["newest_seq"] + 1))
        async with bench.running(bench.service()) as second:
            await other.until(lambda: events(other)[-1]["daemon_boot_id"] == second.daemon_boot_id)
            rest = await missed(bench, after_seq=have[-1]["seq"], daemon_boot_id=first.daemon_boot_id)
            of_first = [event for event in events(other) if event["daemon_boot_id"] == first.daemon_boot_id]
            assert [*have, *map(as_published, rest["events"])] == of_first
            assert (rest["complete"], rest["newest_seq"]) == (True, of_first[-1]["seq"])
            assert rest["next_daemon_boot_id"] == second.daemon_boot_id
            present = await missed(bench)
            assert (rest["daemon_boot_id"], present["daemon_boot_id"]) == (first.daemon_boot_id, second.daemon_boot_id)
            assert {event["daemon_boot_id"] for event in present["events"]} == {second.daemon_boot_id}
            answer = await request(Mqtt(url=bench.broker_url), "hand", "events", {"daemon_boot_id": "of nobody"})
            assert answer["error"]["code"] == "unknown_boot"
