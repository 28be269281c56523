"""The whole daemon between an emulated comb of force sites and a real broker: contacts with places, forces, tare."""

import math
from typing import Any

import pytest
from brokers import Mosquitto
from observer import Observer, observe
from scenarios import IDEAL, touch_text
from service_bench import Bench, events

from resonator_daemon.base.plate import load_plate

PLACE_M = (1.5e-3, -1.0e-3)
SITES = {site.id: site.position_mm for site in load_plate("comb16").sites}


def forces(heard: Observer) -> list[dict[str, Any]]:
    return heard.payloads("resonator/hand/forces")


async def test_a_touch_between_sites_becomes_a_contact_with_place_and_force(bench: Bench, mosquitto: Mosquitto) -> None:
    scenario = bench.scenario(IDEAL + touch_text(0.8, 2.0, 0.6, position_mm=[1.5, -1.0]))
    async with (
        bench.emulated("comb16", scenario=scenario) as emulator,
        observe(mosquitto.url) as heard,
        bench.running(bench.service("comb16", emulator.link.address)) as service,
    ):
        await heard.until(lambda: len(events(heard)) == 2)
        sensor = await heard.until_last("resonator/hand/state/sensor", state="online")
        info = heard.payloads("resonator/hand/info")[-1]
        assert service.link_counters.lost.total == 0
    onset, release = events(heard)
    assert (onset["event"], release["event"]) == ("onset", "release")
    assert onset["contact"]["id"] == release["contact"]["id"]
    assert release["contact"]["peak_newton"] == pytest.approx(2.0, abs=0.05)
    assert release["contact"]["duration_s"] == pytest.approx(0.8, abs=0.1)
    assert "hysteresis" in sensor["reason"]
    assert (info["plate"], info["calibration"]["response"]) == ("comb16", "off")

    by_ticks = {line["board_ticks"]: line["contacts"] for line in bench.truth()}
    held = set()
    for message in heard.payloads("resonator/hand/contacts"):
        true = by_ticks.get(int(message["board_ticks"]), [])
        if true and true[0]["force_newton"][2] > 1.99:
            (contact,) = message["contacts"]
            assert contact["status"] == "ok"
            assert math.dist(contact["position_m"], PLACE_M) < 0.1e-3
            assert contact["force_newton"][2] == pytest.approx(2.0, abs=0.05)
            assert 0 < contact["noise_newton"][2] < contact["systematic_newton"] < 0.2
            held.add(int(message["board_ticks"]))
    assert len(held) > 50
    for message in forces(heard):
        for site in message["sites"] if int(message["board_ticks"]) in held else ():
            x, y = SITES[site["site"]]
            share = (1 + ((x - 1.5) ** 2 + (y + 1.0) ** 2) / 2.5**2) ** -1.5
            assert site["force_newton"] == pytest.approx(2.0 * share, abs=0.05)
    assert sensor["compensation"]["baseline"] == "followed"
    assert sensor["compensation"]["plate_kelvin"] is not None
