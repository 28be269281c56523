"""`resonatord doctor` as a user meets it: verdict, report, exit code."""

import asyncio
import itertools
import json
import re
import socket
from pathlib import Path

import aiomqtt
import pytest
from brokers import Mosquitto
from emulation import emulated
from example_messages import NOW_NS, example
from observer import running_task

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.commands import main
from resonator_daemon.mqtt.payloads import Contacts
from resonator_daemon.tools.doctor import broker_checks, host_checks, link_checks, sensor_checks
from resonator_daemon.tools.doctor import run as doctor_run
from resonator_daemon.tools.doctor.finding import FINE, WIDTH, Area, Report
from simulators.emulator import EmulatorOptions
from simulators.faults import parse_faults

WIRE, PLATE, HOST = link_checks.ERRORS, sensor_checks.TONES, broker_checks.LISTENS


def configuration(folder: Path, link: str, url: str = "mqtt://127.0.0.1:9", plate: str = "quartz16") -> Path:
    path = folder / "hand.toml"
    path.write_text(f'name = "hand"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "{url}"\n')
    return path


def asked(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, object]]:
    printed: dict[str, object] = {"cause": "computer_busy"}
    while printed["cause"] == "computer_busy":  # other findings are then unreliable
        code = main(["doctor", *map(str, arguments), "--json"])
        printed = json.loads(capsys.readouterr().out)
    return code, printed


def outcomes(report: dict[str, object]) -> dict[str, str]:
    findings = report["findings"]
    assert isinstance(findings, list)
    return {finding["id"]: finding["outcome"] for finding in findings}


def test_the_first_cause_is_the_verdict() -> None:
    checks = (HOST, WIRE, link_checks.FITS, PLATE, sensor_checks.CALIBRATION)
    report = Report([check.fault("evidence", "do") for check in reversed(checks)])
    ids = [check.id for check in checks]
    assert [finding["id"] for finding in report.as_json()["findings"]] == ids
    assert re.findall(r"(?<=^  FAULT    )\S+", report.as_text(), re.MULTILINE) == ids
    assert (report.cause.id if report.cause else None, report.verdict) == ("broker.listens", "software")
    assert report.faulty == (Area.SOFTWARE, Area.WIRING, Area.SENSOR)
    assert "5 checks: 5 faults, 0 warnings, 0 ok" in report.as_text()
    report = Report([HOST.warning("h", "do"), WIRE.ok("w"), PLATE.not_checked("p")])
    assert (report.verdict, report.faulty) == (FINE, ())
    assert "3 checks: 0 faults, 1 warning, 1 ok, 1 not checked" in report.as_text()
    assert "1 check: 1 fault, 0 warnings" in Report([WIRE.fault("w", "do")]).as_text()


def test_a_report_fits_the_terminal_and_cannot_steer_it() -> None:
    text = Report([WIRE.fault("words " * 40 + "\x1b[2J\r", "remedy " * 30)]).as_text()
    assert max(map(len, text.splitlines())) <= WIDTH
    assert "\x1b" not in text
    assert "\r" not in text


async def test_a_board_and_a_broker_that_are_well(
    tmp_path: Path, mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host_checks, "is_synchronised", lambda: True)
    port = tmp_path / "board"
    path = configuration(tmp_path, f"serial:{port}?baud=4000000", mosquitto.url)
    with emulated(EmulatorOptions("quartz16", pty=port, scenario="still")):
        code, report = await asyncio.to_thread(asked, capsys, "--config", path, "--seconds", 1)
    found = outcomes(report)
    assert (code, report["verdict"], report["cause"]) == (0, "fine", None), found
    assert "fault" not in found.values()
    assert found["broker.accepts"] == found["sensor.noise"] == found["board.reference"] == "ok"


@pytest.mark.parametrize("plate", ["quartz16", "comb16"])
def test_a_board_on_a_link_is_examined_with_the_plate_it_names(plate: str, capsys: pytest.CaptureFixture[str]) -> None:
    with emulated(EmulatorOptions(plate, tcp=("127.0.0.1", 0), scenario="still")) as emulator:
        code, report = asked(capsys, emulator.link.address, "--seconds", 0.8)
    found = outcomes(report)
    assert (code, report["verdict"]) == (0, "fine"), found
    assert found["sensor.tones"] == found["link.errors"] == "ok"
    assert not any(name.startswith("broker.") for name in found)


def test_frames_that_the_link_loses_are_a_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "board"
    with emulated(EmulatorOptions("quartz16", pty=port, scenario="still", faults=parse_faults("bit_error_rate=2e-5"))):
        code, report = asked(capsys, f"serial:{port}?baud=4000000", "--seconds", 0.8)
    found = outcomes(report)
    assert (code, report["cause"], report["verdict"]) == (1, "link.errors", "wiring")
    assert found["sensor.noise"] == found["sensor.channels"] == "not_checked"


def test_a_wrong_plate_is_a_fault_of_the_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = tmp_path / "board"
    options = EmulatorOptions("quartz16", pty=port, faults=parse_faults("misbehave=other_plate"))
    path = configuration(tmp_path, f"serial:{port}?baud=4000000")
    with emulated(options):
        code, report = asked(capsys, "--config", path)
    found = outcomes(report)
    assert (code, report["verdict"], report["cause"]) == (1, "software", "broker.listens")
    assert (found["link.errors"], found["board.fits"]) == ("not_checked", "fault")
    assert report["faulty"] == ["software", "sensor"]


def test_what_is_no_board_is_the_wirings(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from resonator_daemon.board.session import probe as port_inquiry

    monkeypatch.setattr(port_inquiry, "ANSWER_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        assert asked(capsys, address)[1]["cause"] == "board.answers"
    code, report = asked(capsys, address)
    assert (code, report["verdict"], report["cause"]) == (1, "wiring", "link.opens")


@pytest.mark.parametrize("returned", [5, [5]])
def test_an_extension_whose_findings_are_of_another_type_is_not_checked(
    returned: object, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        doctor_run, "load_entries", lambda _group, _fits: [("cold", lambda _config, _capture: returned)]
    )
    _, report = asked(capsys, "tcp://127.0.0.1:9")
    assert outcomes(report)["cold"] == "not_checked"


@pytest.mark.parametrize(("newton", "outcome"), [(1.25, "ok"), (1.5, "fault")])
async def test_a_known_load_shows_a_wrong_sensitivity(
    tmp_path: Path, mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str], newton: float, outcome: str
) -> None:
    async def publish() -> None:  # 1.234 N, of which 38 mN are uncertain
        async with aiomqtt.Client("127.0.0.1", Mqtt(url=mosquitto.url).port) as client:
            for number in itertools.count():
                message = example(Contacts, seq=number, t_ns=NOW_NS + number * 50_000_000)
                await client.publish("resonator/hand/contacts/20hz", message.model_dump_json())
                await asyncio.sleep(0.01)

    async with running_task(publish()):
        config = "--config", configuration(tmp_path, "tcp://127.0.0.1:9", mosquitto.url)
        _, report = await asyncio.to_thread(asked, capsys, *config, "--load", newton)
    assert outcomes(report)["sensor.load"] == outcome
