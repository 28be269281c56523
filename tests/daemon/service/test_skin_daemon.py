"""The whole daemon between an emulated skin and a real broker: from signals to tractions, contacts and events."""

import os
import signal
from typing import Any

import numpy as np
from brokers import Mosquitto
from observer import Observer, observe
from plates import SMALL_SKIN
from published_schema import ALWAYS, check_all
from scenarios import touch_text
from service_bench import Bench, events

SHEAR = "{peak_ratio = 0.95, direction_deg = 30}"
SHEARED = "period_s = 1.6\n" + touch_text(0.2, 0.8, 1.0, position_mm=[0.6, -0.3], shear=SHEAR)


def summaries(observer: Observer) -> list[dict[str, Any]]:
    return observer.payloads("resonator/hand/decoded/summary")


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
        os.kill(heard.payloads("resonator/hand/health")[-1]["decoder"]["pid"], signal.SIGKILL)
        await heard.until_last("resonator/hand/state/sensor", state="stalled", reason_code="decoder_crashed")
    decoded = {"signals", "signals/5hz", "decoded", "decoded/5hz", "decoded/summary", "decoded/summary/20hz"}
    assert check_all(heard) >= ALWAYS | decoded | {"contacts", "contacts/20hz", "contacts/event"}
    states = heard.payloads("resonator/hand/state/sensor")
    assert {state["state"] for state in states if state["reason_code"] == "decoder_starting"} == {"starting"}
    reasons = [message["reason"] for message in states]
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
    assert pressed.keys() <= set(by_contact)  # the frames of a short contact may be skipped
    assert min(pressed.values()) > 1e-7
    present = [contact for message in heard.payloads("resonator/hand/contacts") for contact in message["contacts"]]
    assert {contact["id"] for contact in present} == set(by_contact)
    near = [contact["site"] for contact in present if contact["force_newton"][2] > 0.6]
    x_mm, y_mm = (np.mean([(site - 1) % 16 for site in near]) - 7.5) * 0.6, (np.mean(near) - 1) // 16 * 0.6 - 4.5
    assert abs(x_mm - 0.6) <= 0.5
    assert abs(y_mm + 0.3) <= 0.6
