"""Every command on a running daemon, between an emulated board and a broker."""

import functools
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from observer import observe
from published_schema import ALWAYS, check_all
from service_bench import Bench

from resonator_daemon.base.host.files import state_directory
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.requests import request
from resonator_daemon.mqtt.verbs import VERBS

FORCES = "resonator/hand/forces"
INFO = "resonator/hand/info"
ALL = [verb.name for verb in VERBS.values() if verb.changes]


def recordings() -> Path:
    """Return where they go unless the configuration says otherwise."""
    return state_directory() / "recordings"


def marks(path: Path) -> list[tuple[int, str]]:
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages(topics=["marks"])
        return [(message.log_time, json.loads(message.data)["message"]) for _, _, message in messages]


def ticks_per_message(messages: list[dict[str, Any]]) -> set[float]:
    """Return the distances of messages by the board's clock, over those of their numbers: late ones are skipped."""
    return {
        (int(later["board_ticks"]) - int(before["board_ticks"])) / (later["seq"] - before["seq"])
        for before, later in pairwise(messages)
    }


async def test_each_command_does_what_it_states(bench: Bench) -> None:
    async def ask(verb: str, **payload: Any) -> dict[str, Any]:
        answer = await request(Mqtt(url=bench.broker_url), "hand", verb, {"id": verb, **payload})
        assert answer["ok"], answer
        assert answer["id"] == verb
        return answer

    async with (
        bench.emulated(scenario="still"),
        observe(bench.broker_url) as observer,
        bench.running(bench.service(allow=tuple(ALL))) as service,
    ):
        await observer.until_last("resonator/hand/state/sensor", state="online")
        info = await observer.until_last(INFO, window_s=0.01)
        assert set(info["commands"]) == set(VERBS)
        pong = await ask("ping")
        assert pong["daemon_boot_id"] == info["daemon_boot_id"]
        assert 0 < pong["uptime_s"] < 600
        assert len((await ask("tare"))["common_mode"]) == 4
        assert (await ask("identify"))["ok"]

        started = await ask("start_recording", label="still")
        running = {"file": started["file"], "since_t_ns": started["since_t_ns"], "failure": None}
        health = functools.partial(observer.payloads, "resonator/hand/health")
        await observer.until(lambda: running.items() <= (health() or [{"recording": {}}])[-1]["recording"].items())
        marked = await ask("mark", text="nothing touches it")
        assert int(marked["t_ns"]) > int(started["since_t_ns"])
        recording = (await ask("stop_recording"))["recording"]
        path = Path(recording["file"])
        assert path.parent == recordings()
        assert (path.stat().st_size, recording["events_missing"]) == (recording["all_bytes"], 0)
        assert marks(path) == [(int(marked["t_ns"]), "nothing touches it")]

        (step_ticks,) = ticks_per_message(observer.payloads(FORCES))
        assert await ask("set_window", window_ms=20, step_ms=10) == {
            "verb": "set_window", "ok": True, "id": "set_window", "window_s": 0.02, "step_s": 0.01
        }  # fmt: skip
        await observer.until_last(INFO, window_s=0.02, step_s=0.01)
        await observer.until_last(FORCES, window_s=0.02)
        count = len(observer.payloads(FORCES))
        await observer.until_count(FORCES, count + 5)
        assert ticks_per_message(observer.payloads(FORCES)[count:]) == {2 * step_ticks}

        assert (await ask("events", after_seq=0))["events"] == []
        assert service.link_counters.lost.total == 0
        await observer.client.publish("resonator/hand/cmd/ping", "{}", qos=1)  # without a response topic
        await observer.until_count("resonator/hand/rsp/ping", 1)
    measured = {"forces", "forces/20hz", "contacts", "contacts/20hz", "tones"}
    commands = {f"cmd/{verb}" for verb in VERBS} | {f"rsp/{verb}/+" for verb in VERBS} | {"rsp/ping"}
    assert check_all(observer) == ALWAYS | measured | commands


async def test_without_permission_nothing_is_changed(bench: Bench) -> None:
    async with bench.emulated(scenario="still"), observe(bench.broker_url) as observer, bench.running(bench.service()):
        await observer.until_last("resonator/hand/state/sensor", state="online")
        info = await observer.until_last(INFO, window_s=0.01)
        assert info["commands"] == ["ping", "events"]
        for verb in ALL:
            answer = await request(Mqtt(url=bench.broker_url), "hand", verb, {})
            assert answer["error"]["code"] == "not_permitted"
        before = len(observer.payloads("resonator/hand/health"))
        await observer.until(lambda: len(observer.payloads("resonator/hand/health")) > before + 1)
        assert observer.payloads("resonator/hand/health")[-1]["recording"]["files"] == 0
        assert observer.payloads("resonator/hand/health")[-1]["commands"] == {"not_permitted": len(ALL)}
        assert len(observer.payloads(INFO)) == 1
        assert not recordings().exists()
