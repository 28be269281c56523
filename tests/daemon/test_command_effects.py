"""What commands do to a daemon that is busy: under a touch, in a flood, and in a recording that is played again."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brokers import Mosquitto
from observer import Observer, observe
from scenarios import IDEAL, touch_text
from service_bench import Bench, events

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.requests import request

pytestmark = pytest.mark.undisturbed

HELD = IDEAL + touch_text(0.4, 2.0, 60, site=7)
ALL = ("tare", "start_recording", "stop_recording", "mark", "set_window", "set_rate", "identify")


@pytest.fixture
def bench(tmp_path: Path, mosquitto: Mosquitto) -> Bench:
    return Bench(tmp_path, mosquitto.url)


async def ask(bench: Bench, verb: str, **payload: Any) -> dict[str, Any]:
    return await request(Mqtt(url=bench.broker_url), "hand", verb, payload)


def forces(heard: Observer) -> list[dict[str, Any]]:
    return heard.payloads("resonator/hand/forces")


async def test_the_window_changes_under_a_touch_that_goes_on(bench: Bench, mosquitto: Mosquitto) -> None:
    async with (
        bench.emulated(scenario=bench.scenario(HELD)),
        observe(mosquitto.url) as heard,
        bench.running(bench.service(allow=ALL)),
    ):
        await heard.until(lambda: len(events(heard)) == 1)
        await heard.until(
            lambda: any(site["force_newton"] > 1.99 for message in forces(heard)[-1:] for site in message["sites"])
        )
        await heard.until_count("resonator/hand/forces", len(forces(heard)) + 20)
        before = forces(heard)[-10:]
        answer = await ask(bench, "set_window", window_ms=20, step_ms=10)
        assert answer["ok"], answer
        await heard.until(lambda: forces(heard)[-1]["window_s"] == pytest.approx(0.02))
        info = await heard.until_last("resonator/hand/info", window_s=0.02, step_s=0.01)
        await heard.until_count("resonator/hand/forces", len(forces(heard)) + 20)
        after = forces(heard)[-10:]
        wrong = await ask(bench, "set_window", window_ms=2.5, step_ms=10)
        assert len(events(heard)) == 1
    assert info["rates_hz"]["forces"] == pytest.approx(100)
    means = [np.mean([message["sites"][0]["force_newton"] for message in part]) for part in (before, after)]
    assert means[0] == pytest.approx(means[1], abs=0.005)
    steps = np.diff([int(message["board_ticks"]) for message in after])
    np.testing.assert_allclose(steps, 10_000_000, rtol=1e-3)
    assert wrong["error"]["code"] == "window"
    assert "whole number of frame periods" in wrong["error"]["message"]
