"""The whole daemon between an emulated skin and a real broker: from signals to tractions, contacts and events."""

from pathlib import Path
from typing import Any

import cbor2
import numpy as np
import pytest
from brokers import Amqtt, Mosquitto
from observer import Observer, observe
from scenarios import touch_text
from service_bench import Bench, events
from system_parts import SMALL_SKIN

SHEAR = "{peak_ratio = 0.95, direction_deg = 30}"
SHEARED = "period_s = 1.6\n" + touch_text(0.2, 0.8, 1.0, position_mm=[0.6, -0.3], shear=SHEAR)


@pytest.fixture
def bench(tmp_path: Path, mosquitto: Mosquitto) -> Bench:
    return Bench(tmp_path, mosquitto.url)


def summaries(observer: Observer) -> list[dict[str, Any]]:
    return observer.payloads("resonator/hand/decoded/summary")


def array_of(value: Any) -> np.ndarray:
    """Read an RFC 8746 array by hand."""
    assert value.tag == 40
    shape, elements = value.value
    assert elements.tag == 85
    return np.frombuffer(elements.value, "<f4").reshape(shape)


def is_firm(contacts: dict[str, Any]) -> bool:
    return any(contact["force_newton"][2] > 0.7 for contact in contacts["contacts"])


async def test_a_pressed_skin_becomes_traction(tmp_path: Path, broker: Mosquitto | Amqtt) -> None:
    bench = Bench(tmp_path, broker.url)
    async with (
        bench.emulated("skin32") as emulator,
        observe(broker.url) as heard,
        bench.running(bench.service("skin32", emulator.link.address)) as service,
    ):
        await heard.until(lambda: len([1 for summary in summaries(heard) if summary["patches"]]) >= 20)
        await heard.until(lambda: any(is_firm(contacts) for contacts in heard.payloads("resonator/hand/contacts")))
        sensor = await heard.until_last("resonator/hand/state/sensor", state="online")
        assert service.link_counters.lost.total == 0
    assert sensor["reason"] == "all sites are read"
    truth = {line["board_ticks"]: line["contacts"] for line in bench.truth()}
    peak_seen = 0.0
    for payload in heard.raw("resonator/hand/decoded"):
        message = cbor2.loads(payload)
        traction, std = array_of(message["traction_pascal"]), array_of(message["traction_std_pascal"])
        assert traction.shape == std.shape == array_of(message["displacement_m"]).shape == (3, 32, 32)
        assert np.isfinite(traction).all()
        assert (std > 0).all()
        contacts = truth.get(message["board_ticks"], [])
        if contacts and contacts[0]["force_newton"][2] > 0.5:
            x, y = contacts[0]["position_m"]
            row, column = np.unravel_index(traction[2].argmax(), (32, 32))
            origin_x, origin_y = message["grid"]["origin_m"]
            pitch = message["grid"]["pitch_m"]
            assert abs(origin_x + column * pitch - x) < 1.5e-3
            assert abs(origin_y + row * pitch - y) < 1.5e-3
            force = traction[2].sum() * pitch**2
            assert force == pytest.approx(contacts[0]["force_newton"][2], rel=0.15)
            peak_seen = max(peak_seen, force)
    assert peak_seen > 0.5
    signals = cbor2.loads(heard.raw("resonator/hand/signals")[-1])
    assert array_of(signals["signals"]).shape == (3, 1024)
    assert {(summary["decoder"], summary["status"]) for summary in summaries(heard)} == {("fourier", "ok")}


async def test_a_sheared_press_on_a_skin_becomes_a_contact_with_its_events(bench: Bench, mosquitto: Mosquitto) -> None:
    """By the decoder that nobody asked for by name."""
    plate = bench.folder / "small.toml"
    plate.write_text(SMALL_SKIN)
    async with (
        bench.emulated(str(plate), scenario=bench.scenario(SHEARED)) as emulator,
        observe(mosquitto.url) as heard,
        bench.running(bench.service(str(plate), emulator.link.address, decoding="")) as service,
    ):
        # Touches repeat, for as long as it takes: the decoder is set up while the first ones pass.
        await heard.until(lambda: {"onset", "incipient_slip", "release"} <= {event["event"] for event in events(heard)})
        await heard.until_last("resonator/hand/state/sensor", state="online", reason="all sites are read")
        assert service.link_counters.lost.total == 0
    reasons = [message["reason"] for message in heard.payloads("resonator/hand/state/sensor")]
    assert any("decoder is being set up: contact physics" in reason for reason in reasons)
    by_contact: dict[int, list[str]] = {}
    for event in events(heard):
        by_contact.setdefault(event["contact"]["id"], []).append(event["event"])
    for words in by_contact.values():
        assert words[0] == "onset"
        assert len(set(words)) == len(words)
        assert "release" not in words[:-1]
    assert any(words[-1] == "release" for words in by_contact.values())

    truth = {line["board_ticks"]: line["contacts"] for line in bench.truth()}
    forces = []
    for message in heard.payloads("resonator/hand/contacts"):
        contacts = truth.get(int(message["board_ticks"]), [])
        if message["status"] == "ok" and contacts and contacts[0]["force_newton"][2] > 0.6 and message["contacts"]:
            (contact,) = message["contacts"]
            np.testing.assert_allclose(contact["position_m"], [0.6e-3, -0.3e-3], atol=2e-4)
            forces.append((contact["force_newton"], contacts[0]["force_newton"]))
    found, true = np.swapaxes(forces, 0, 1)
    np.testing.assert_allclose(found.mean(axis=0), true.mean(axis=0), atol=0.02)
    # Every contact has the site that is nearest; the summary has its area.
    assert {summary["decoder"] for summary in summaries(heard)} == {"open-plane+contact"}
    pressed = {patch["id"]: patch["area_m2"] for summary in summaries(heard) for patch in summary["patches"]}
    assert pressed.keys() == set(by_contact)
    assert min(pressed.values()) > 1e-7
    present = [contact for message in heard.payloads("resonator/hand/contacts") for contact in message["contacts"]]
    assert {contact["id"] for contact in present} == set(by_contact)
    near = [contact["site"] for contact in present if contact["force_newton"][2] > 0.6]
    x_mm, y_mm = (np.mean([(site - 1) % 16 for site in near]) - 7.5) * 0.6, (np.mean(near) - 1) // 16 * 0.6 - 4.5
    assert abs(x_mm - 0.6) <= 0.5
    assert abs(y_mm + 0.3) <= 0.6
