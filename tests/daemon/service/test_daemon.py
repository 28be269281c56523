"""The whole daemon between an emulated board and a real broker, observed by a plain subscriber."""

import asyncio
import logging
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from brokers import Amqtt, Mosquitto
from observer import Observer, observe
from plates import SMALL_SKIN
from published_schema import ALWAYS, check_all
from scenarios import IDEAL, touch_text
from service_bench import Bench, events

from firmware_protocol.packets import encode_packet
from resonator_daemon.base.errors import ConfigurationError, ExitCode, IncompatibleBoardError
from resonator_daemon.base.plate import load_plate
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.requests import request
from simulators.faults import parse_faults


def touched(hold_s: float, start_s: float = 0.4, **keys: float) -> str:
    return touch_text(start_s, 2.0, hold_s, site=7, **keys)


async def test_a_touch_becomes_messages_on_either_broker(tmp_path: Path, broker: Mosquitto | Amqtt) -> None:
    bench = Bench(tmp_path, broker.url)
    scenario = bench.scenario(IDEAL + touched(0.3))
    async with observe(broker.url) as observer, bench.measured(observer, bench.service(), scenario=scenario) as service:
        await observer.until(lambda: len(events(observer)) == 2)
        onset, release = events(observer)
        assert service.link_counters.lost.total == 0
    assert (onset["event"], release["event"]) == ("onset", "release")
    assert onset["contact"]["site"] == release["contact"]["site"] == 7
    assert onset["contact"]["id"] == release["contact"]["id"]
    true_m = np.multiply(1e-3, load_plate("quartz16").sites[6].position_mm)
    np.testing.assert_allclose(onset["contact"]["position_m"], true_m)
    assert release["contact"]["peak_newton"] == pytest.approx(2.0, abs=0.01)

    # Compared with the truth averaged over the same window, reading by reading.
    errors = []
    for message, window in bench.windows(observer.payloads("resonator/hand/forces")):
        true = sum(contact["force_newton"][2] for line in window for contact in line["contacts"]) / len(window)
        middle_ns = (int(window[0]["t_ns"]) - 1_000_000 + int(window[-1]["t_ns"])) / 2
        assert abs(int(message["t_ns"]) - middle_ns) <= message["t_uncertainty_ns"] + 100_000
        errors += [site["force_newton"] - true for site in message["sites"] if true > 0.1]
    assert len(errors) > 50
    assert np.sqrt(np.mean(np.square(errors))) <= 0.005

    # The tone of each corner is f0 / (1 - K F) of the pressed site.
    (tone,) = load_plate("quartz16").sites[6].tones
    for message, window in bench.windows(observer.payloads("resonator/hand/tones")):
        true = sum(contact["force_newton"][2] for line in window for contact in line["contacts"]) / len(window)
        if true > 1.0:
            assert [corner["site"] for corner in message["corners"]] == [7] * 4
            expected_hz = np.divide(tone.f0_hz, 1 - np.multiply(tone.sensitivity, true))
            np.testing.assert_allclose([c["frequency_hz"] for c in message["corners"]], expected_hz, rtol=2e-7)
    assert check_all(observer) >= ALWAYS - {"health"} | {"contacts/event", "forces", "contacts", "tones"}
    info = observer.payloads("resonator/hand/info")[-1]
    assert (info["plate"], info["serial_number"], len(info["sites"])) == ("quartz16", "EMU-0001", 16)


async def test_the_log_has_state_codes(bench: Bench, mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    async with bench.emulated(scenario="still"), observe(mosquitto.url) as observer, bench.running(bench.service()):
        for part in ("daemon", "link", "sensor"):
            await observer.until_last(f"resonator/hand/state/{part}", state="online")
    for subject, code in (("daemon", "measuring"), ("link", "board_counts"), ("sensor", "measuring")):
        lines = [vars(record) for record in caplog.records if hasattr(record, f"resonatord_{subject}_state")]
        assert (lines[-1][f"resonatord_{subject}_state"], lines[-1]["resonatord_reason_code"]) == ("online", code)
        assert lines[-1]["levelno"] == logging.INFO


async def test_a_serial_number_that_is_no_topic_needs_a_name(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulators.emulator.SERIAL_NUMBER", "decoder")
    async with bench.emulated(scenario="still"):
        with pytest.raises(ConfigurationError, match=r"serial number .decoder. .*; set name in the configuration"):
            await bench.service(name=None).run()


async def test_a_board_for_another_plate_ends_the_daemon(bench: Bench, mosquitto: Mosquitto) -> None:
    async with bench.emulated(scenario="still", tcp=("127.0.0.1", 0)) as emulator, observe(mosquitto.url) as observer:
        with pytest.raises(
            ConfigurationError, match="the board describes quartz16, the plate file has skin32"
        ) as refused:
            await bench.service("skin32", emulator.link.address).run()
        await observer.until_last("resonator/hand/state/link", state="refused")
    assert refused.value.exit_code == ExitCode.CONFIG


async def test_another_protocol_ends_the_daemon_with_both_versions_named(bench: Bench) -> None:
    async def other_version(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(encode_packet(0x81, 1, b"?", boot_id=7, major=2))
        await writer.drain()
        writer.close()

    async with await asyncio.start_server(other_version, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        with pytest.raises(IncompatibleBoardError, match="uses protocol 2, this daemon uses 1") as refused:
            await bench.service("skin32", f"tcp://127.0.0.1:{port}").run()
    assert refused.value.exit_code == ExitCode.UNAVAILABLE


async def test_contacts_end_when_frames_have_stopped_coming(bench: Bench, mosquitto: Mosquitto) -> None:
    faults = parse_faults("unplug_at_s=1,unplug_for_s=2")
    board = {"scenario": bench.scenario(IDEAL + touched(10)), "faults": faults}
    async with observe(mosquitto.url) as observer:
        async with bench.measured(observer, bench.service(), **board):
            await observer.until(lambda: len(events(observer)) >= 2)
            await observer.until(lambda: observer.payloads("resonator/hand/state/link")[-1]["state"] != "online")
            await observer.until(lambda: len(events(observer)) >= 3)
        await observer.until_last("resonator/hand/state/daemon", state="offline")
        assert len(events(observer)) == 4  # the open contact is released first
    first, lost, again, stopped = events(observer)
    assert [event["event"] for event in (first, lost, again, stopped)] == ["onset", "release", "onset", "release"]
    assert lost["reason_code"] == "no_frames"
    assert lost["contact"]["id"] == first["contact"]["id"] != again["contact"]["id"]
    assert again["contact"]["site"] == 7
    assert (stopped["reason_code"], stopped["contact"]["id"]) == ("stopped", again["contact"]["id"])


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
        observe(mosquitto.url) as observer,
        bench.running(bench.service(str(plate), emulator.link.address, decoding="")) as service,
    ):
        # Touches repeat, for as long as it takes: the decoder is set up while the first ones pass.
        await observer.until(
            lambda: {"onset", "incipient_slip", "release"} <= {event["event"] for event in events(observer)}
        )
        await observer.until_last("resonator/hand/state/sensor", state="online", reason="all sites are read")
        assert service.link_counters.lost.total == 0
        os.kill(observer.payloads("resonator/hand/health")[-1]["decoder"]["pid"], signal.SIGKILL)
        await observer.until_last("resonator/hand/state/sensor", state="stalled", reason_code="decoder_crashed")
    decoded = {"signals", "signals/5hz", "decoded", "decoded/5hz", "decoded/summary", "decoded/summary/20hz"}
    assert check_all(observer) >= ALWAYS | decoded | {"contacts", "contacts/20hz", "contacts/event"}
    states = observer.payloads("resonator/hand/state/sensor")
    assert {state["state"] for state in states if state["reason_code"] == "decoder_starting"} == {"starting"}
    reasons = [message["reason"] for message in states]
    assert any("decoder is being set up: contact physics" in reason for reason in reasons)
    by_contact: dict[int, list[str]] = {}
    for event in events(observer):
        by_contact.setdefault(event["contact"]["id"], []).append(event["event"])
    for words in by_contact.values():
        assert words[0] == "onset"
        assert len(set(words)) == len(words)
        assert "release" not in words[:-1]
    assert any(words[-1] == "release" for words in by_contact.values())

    # tests/test_coordinates.py compares places and forces with the truth.
    assert {summary["decoder"] for summary in summaries(observer)} == {"open-plane+contact"}
    pressed = {patch["id"]: patch["area_m2"] for summary in summaries(observer) for patch in summary["patches"]}
    assert pressed.keys() <= set(by_contact)  # the frames of a short contact may be skipped
    assert min(pressed.values()) > 1e-7
    present = [contact for message in observer.payloads("resonator/hand/contacts") for contact in message["contacts"]]
    assert {contact["id"] for contact in present} == set(by_contact)


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
