"""A recording that the daemon made replays as what it published then, message by message."""

import json
from pathlib import Path
from typing import Any

from brokers import Mosquitto
from observer import Observer, observe
from plates import SMALL_SKIN
from scenarios import IDEAL, touch_text
from service_bench import Bench, events

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.daemon.service.daemon import Service
from resonator_daemon.mqtt.codec import decode
from resonator_daemon.mqtt.requests import request
from resonator_daemon.mqtt.topics import TOPICS
from resonator_daemon.tools.replay.outputs import payload_json
from resonator_daemon.tools.replay.recorded_pipeline import open_replay
from simulators.faults import parse_faults

TOUCHES = touch_text(0.4, 2.0, 0.3, site=7) + touch_text(1.2, 2.0, 0.6, site=3)
COMPARED = ("forces", "contacts", "contacts/event", "signals", "state/link", "state/sensor", "info")
OF_THE_RUN = ("daemon_boot_id", "commands", "rates_hz")  # what the link has no part in


def recording_service(bench: Bench, plate: str, link: str) -> Service:
    recording = ("[recording]", "autostart = true", f'directory = "{bench.folder}"', "min_free_mb = 0")
    return bench.service(plate, link, decoding='method = "off"', allow=("tare", "set_window"), tables=recording)


def replayed(path: Path) -> dict[str, list[dict[str, Any]]]:
    by_topic: dict[str, list[dict[str, Any]]] = {}
    with open_replay(path) as replaying:
        for moment in replaying.moments():
            for topic, message in moment.messages:
                by_topic.setdefault(topic.path, []).append(json.loads(payload_json(message)))
        assert (replaying.differences, replaying.damage) == (0, None)
    return by_topic


def of_the_link(payload: dict[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in payload.items() if key not in OF_THE_RUN}
    return kept | {"lost": payload["lost"] | {"publish_dropped": 0, "skipped_late": 0}}


def check_same(heard: Observer, again: dict[str, list[dict[str, Any]]]) -> dict[str, int]:
    """Compare what was heard with what is replayed; return how many messages of each topic that were."""
    counts = {}
    for path in COMPARED:
        kind = TOPICS[path].payload
        messages = [decode(kind, raw) for raw in heard.raw(f"resonator/hand/{path}")]
        live = [json.loads(payload_json(message)) for message in messages]
        by_seq = {payload["seq"]: of_the_link(payload) for payload in again.get(path, [])}
        assert len(by_seq) == len(again.get(path, []))
        for payload in live:
            assert by_seq[payload["seq"]] == of_the_link(payload)
        counts[path] = len(live)
    return counts


async def test_force_sites_replay_as_they_were_published(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    faults = parse_faults("bit_error_rate=1e-5,unplug_at_s=1.5,unplug_for_s=0.6,reboot_at_s=2.7")
    scenario = bench.scenario(IDEAL + TOUCHES)
    async with observe(mosquitto.url) as heard:
        service = recording_service(bench, "quartz16", f"serial:{bench.port}?baud=4000000")
        async with bench.emulated(scenario=scenario, faults=faults), bench.running(service):
            await heard.until(lambda: len(events(heard)) >= 4)
            await heard.until_last("resonator/hand/state/link", state="online", boot_count=2)
            count = len(heard.raw("resonator/hand/forces"))
            await heard.until_count("resonator/hand/forces", count + 100)
            wanted = request(Mqtt(url=mosquitto.url), "hand", "set_window", {"window_ms": 20, "step_ms": 10})
            assert (await wanted)["ok"]
            for _ in range(20):  # refused while a damaged frame is in the window: its pilot is not known
                answer = await request(Mqtt(url=mosquitto.url), "hand", "tare", {})
                if answer["ok"]:
                    break
            assert answer["ok"], answer
            await heard.until_count("resonator/hand/forces", count + 150)
    (path,) = tmp_path.glob("*.mcap")
    again = replayed(path)
    counts = check_same(heard, again)
    assert counts["forces"] >= 250
    assert counts["contacts/event"] >= 4
    assert counts["state/link"] >= 6  # one that is overtaken by the next is not sent
    assert any("damaged" in message["lost"] for message in again["forces"])
    assert any("last_outage" in message for message in again["state/link"])
    assert again["state/link"][-1]["boot_count"] == 2


async def test_the_signals_of_a_skin_replay_as_they_were_published(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    plate = tmp_path / "small.toml"
    plate.write_text(SMALL_SKIN)
    async with observe(mosquitto.url) as heard, bench.emulated(str(plate), scenario="press-and-shear") as emulator:
        service = recording_service(bench, str(plate), emulator.link.address)
        async with bench.running(service):
            await heard.until_count("resonator/hand/signals", 40)
    (path,) = tmp_path.glob("*.mcap")
    counts = check_same(heard, replayed(path))
    assert counts["signals"] >= 40
