"""One who comes late tells eight situations apart by what is retained, with the example that users are given."""

import asyncio
import json
import os
import runpy
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from brokers import Mosquitto
from command_line import PROGRAM
from observer import Observer, observe
from scenarios import IDEAL
from service_bench import Bench

from simulators.faults import parse_faults

EXAMPLE = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "examples" / "python" / "situation.py"))
situation: Callable[[dict[str, Any]], str] = EXAMPLE["situation"]

BASE = "resonator/hand/state"
WARMED = "environment_kelvin = [[0, 298.15], [1, 298.15], [6, 318.15]]\n" + IDEAL
S = 1_000_000_000


@pytest.fixture
def bench(tmp_path: Path, mosquitto: Mosquitto) -> Bench:
    return Bench(tmp_path, mosquitto.url)


async def well(observer: Observer) -> None:
    for word in ("daemon", "link", "sensor"):
        await observer.until_last(f"{BASE}/{word}", state="online")


async def seen_late(broker: Mosquitto) -> dict[str, Any]:
    """The retained states, as one hears them who comes now; the last word on its own topic marks the end of them."""
    async with observe(broker.url) as late:
        await late.client.publish("mark/end", b"{}", qos=1)
        await late.until_count("mark/end", 1)
        said = [message for message in late.messages if message.retain and message.topic.matches(f"{BASE}/+")]
    return {message.topic.value.rpartition("/")[2]: json.loads(message.payload) for message in said}


def since_s(state: dict[str, Any]) -> float:
    return int(state["since_t_ns"]) / S


async def test_never_started(mosquitto: Mosquitto) -> None:
    states = await seen_late(mosquitto)
    assert states == {}
    assert situation(states) == "never started"


async def test_clean_stop(bench: Bench, mosquitto: Mosquitto) -> None:
    async with bench.emulated(scenario=bench.scenario(IDEAL)), observe(mosquitto.url) as observer:
        async with bench.running(bench.service()):
            await well(observer)
            assert situation(await seen_late(mosquitto)) == "well"
            stopped_s = time.time()
        states = await seen_late(mosquitto)
    assert situation(states) == "clean stop"
    assert since_s(states["daemon"]) >= stopped_s
    assert len({state["daemon_boot_id"] for state in states.values()}) == 1


async def test_crash(bench: Bench, mosquitto: Mosquitto) -> None:
    bench.service()  # which writes the configuration
    command = (*PROGRAM, "run", "--config", str(bench.folder / "board.toml"))
    async with bench.emulated(scenario=bench.scenario(IDEAL)), observe(mosquitto.url) as observer:
        daemon = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.DEVNULL)
        await well(observer)
        os.kill(daemon.pid, signal.SIGKILL)
        await daemon.wait()
        await observer.until_last(f"{BASE}/daemon", state="offline")
        states = await seen_late(mosquitto)
    assert situation(states) == "crash"
    assert states["daemon"]["since_t_ns"] is None


async def test_broker_restarted_empty(bench: Bench, mosquitto: Mosquitto) -> None:
    async with bench.emulated(scenario=bench.scenario(IDEAL)), bench.running(bench.service()):
        async with observe(mosquitto.url) as observer:
            await well(observer)
            first = observer.payloads(f"{BASE}/daemon")[-1]
        await mosquitto.kill()
        back_s = time.time()
        await mosquitto.start()
        async with observe(mosquitto.url) as observer:
            await well(observer)
            await observer.until_count("resonator/hand/schema", 1)
            await observer.until_count("resonator/hand/info", 1)
        states = await seen_late(mosquitto)
    assert situation(states) == "broker restarted"
    assert (first["connections"], states["daemon"]["connections"]) == (1, 2)
    assert int(states["daemon"]["connected_t_ns"]) / S >= back_s
    assert states["daemon"]["since_t_ns"] == first["since_t_ns"]


async def test_cable_out(bench: Bench, mosquitto: Mosquitto) -> None:
    async with observe(mosquitto.url) as observer, bench.running(bench.service()):
        async with bench.emulated(scenario=bench.scenario(IDEAL)):
            await well(observer)
            pulled_s = time.time()
        await observer.until_last(f"{BASE}/sensor", state="waiting")
        states = await seen_late(mosquitto)
    assert situation(states) == "cable out"
    assert pulled_s <= since_s(states["link"]) <= time.time()


@pytest.mark.parametrize(
    ("scenario", "faults", "word", "state", "expected"),
    [
        (IDEAL, "freeze_at_s=1,freeze_for_s=60", "link", {"state": "stalled"}, "board hung"),
        (IDEAL, "reboot_at_s=1", "link", {"state": "online", "boot_count": 2}, "board rebooted"),
        (WARMED.replace("ideal = true", ""), "", "sensor", {"state": "drifting"}, "sensor drifting"),
    ],
)
async def test_what_happens_to_the_board(
    bench: Bench, mosquitto: Mosquitto, scenario: str, faults: str, word: str, state: dict[str, Any], expected: str
) -> None:
    async with (
        bench.emulated(scenario=bench.scenario(scenario), faults=parse_faults(faults)),
        observe(mosquitto.url) as observer,
        bench.running(bench.service()),
    ):
        await observer.until_last(f"{BASE}/{word}", **state)
        async with asyncio.timeout(30):  # after a reboot the sensor's state is still that of the boot before
            while situation(await seen_late(mosquitto)) != expected:
                pass
