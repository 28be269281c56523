"""A daemon that has the link already: it is found, heard, and not disturbed."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from brokers import Mosquitto
from made_up_host import MadeUpHost
from observer import Observer, observe
from service_bench import Bench

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.reasons import Condition, ReasonCode
from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.carriers.tcp import TcpTarget
from resonator_daemon.board.links.carriers.usb import UsbTarget
from resonator_daemon.board.links.port_holders import Holder, Holders
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.commands import main
from resonator_daemon.daemon.monitoring.status_client import Answer, ask_all
from resonator_daemon.tools.doctor import daemon_checks, run
from resonator_daemon.tools.doctor.daemon_checks import check_daemon, find_daemon
from resonator_daemon.tools.doctor.finding import STATE_REMEDIES, Outcome
from resonator_daemon.tools.doctor.run import DoctorOptions, doctor

STATUS: dict[str, Any] = {
    "pid": 77,
    "config": {"in_use": "file", "file": "/none/hand.toml", "problems": [], "needs_restart": []},
    "link": {"state": "online", "reason": ""},
    "sensor": {"state": "online", "reason": ""},
    "health": {"boots": [{"frames": 10_000, "lost": {"damaged": 0}}]},
}


BUSY = {"reason_code": "computer_busy", "reason": "x"}


def unplugged(hit: int, **more: int) -> dict[str, Any]:
    """Return the health after an outage of 3007 frames, with `hit` frames lost besides it."""
    in_outages = {"link_gap": 3000, "damaged": 7, **more}
    lost = in_outages | {"link_gap": 3000 + hit}
    return {"boots": [{"frames": 12_002, "lost": lost, "lost_in_outages": in_outages}]}


@pytest.fixture
def bench(tmp_path: Path, mosquitto: Mosquitto) -> Bench:
    return Bench(tmp_path, mosquitto.url)


def answering(
    monkeypatch: pytest.MonkeyPatch, status: dict[str, Any] | None, socket: Path = Path("/r/other/status.sock")
) -> None:
    async def answers(_wanted: str | None) -> list[Answer]:
        return [Answer(socket, status, None if status else "runs and gives no answer")]

    monkeypatch.setattr(daemon_checks, "ask_all", answers)


def judged(**change: object) -> dict[str, Outcome]:
    return {finding.id: finding.outcome for finding in check_daemon(Answer(Path("/none"), STATUS | change, None))}


def unopenable(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(_link: LinkTarget) -> None:
        raise AssertionError("the daemon's link was opened")

    for target in (SerialTarget, TcpTarget):
        monkeypatch.setattr(target, "open", opened)


async def measuring(heard: Observer) -> None:
    for path in ("link", "sensor"):
        await heard.until_last(f"resonator/hand/state/{path}", state="online")
    await heard.until_count("resonator/hand/health", len(heard.raw("resonator/hand/health")) + 1)


@pytest.mark.parametrize("by_configuration", [True, False])
async def test_a_running_daemon_counts_on_while_the_doctor_looks(
    bench: Bench, by_configuration: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    async with bench.emulated(scenario="still"), observe(bench.broker_url) as heard, bench.running(bench.service()):
        await measuring(heard)
        asked = (
            ["--config", str(bench.folder / "board.toml")] if by_configuration else [f"serial:{bench.port}?baud=9600"]
        )
        before = (await ask_all(None))[0].status
        count = len(heard.payloads("resonator/hand/forces"))
        found: dict[str, str] = {}
        while found.get("daemon.link") != "ok":  # a busy computer's board is late at times, which is its state then
            await asyncio.to_thread(main, ["doctor", *asked, "--json"])
            findings = json.loads(capsys.readouterr().out)["findings"]
            found = {finding["id"]: finding["outcome"] for finding in findings}
        await heard.until(lambda: len(heard.payloads("resonator/hand/forces")) > count + 5)
        after = (await ask_all(None))[0].status
    assert before is not None
    assert after is not None
    assert (found["daemon.runs"], found["daemon.sensor"], found["sensor.noise"]) == ("ok", "ok", "not_checked")
    states = {state["state"] for state in heard.payloads("resonator/hand/state/link")}
    assert not states & {"lost", "waiting"}
    assert "link.opens" not in found
    (boot,) = after["health"]["boots"]
    for cause in ("link_gap", "damaged"):
        assert boot["lost"][cause] == before["health"]["boots"][0]["lost"][cause]
    assert boot["connections"] == after["health"]["connections"] == 1


async def test_a_daemon_is_found_by_pid_file_or_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = TcpTarget("127.0.0.1", 9)
    file = tmp_path / "hand.toml"
    file.write_text('plate = "quartz16"\nlink = "tcp://127.0.0.1:9"\n')
    answering(monkeypatch, STATUS)
    assert await find_daemon(link, None, {78}) is None
    assert await find_daemon(link, None, {77}) is not None
    answering(monkeypatch, STATUS | {"config": {"file": str(file)}})
    assert await find_daemon(link, None, ()) is not None
    other = TcpTarget("127.0.0.1", 10)
    assert await find_daemon(other, None, ()) is None
    assert await find_daemon(other, file, ()) is not None
    answering(monkeypatch, STATUS | {"config": {"file": str(file), "needs_restart": ["link"]}})
    assert await find_daemon(link, None, ()) is None
    answering(monkeypatch, None, Path("/r/hand/status.sock"))
    assert await find_daemon(link, file, ()) is not None
    assert await find_daemon(link, tmp_path / "foot.toml", ()) is None


def looked(computer: MadeUpHost, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    try:
        doctor(DoctorOptions(None, UsbTarget(0x1A86, 0x7523, "0042"), 1.0, json=True, host=computer.host()))
        findings = json.loads(capsys.readouterr().out)["findings"]
    except UserError as fault:
        findings = fault.partial_result["findings"]
    return {finding["id"]: finding for finding in findings}


def test_a_usb_device_that_a_daemon_has_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    computer = MadeUpHost(tmp_path)
    unopenable(monkeypatch)
    monkeypatch.setattr(
        run,
        "port_holders",
        lambda node: Holders((Holder(77, "resonatord", False),) if node.endswith("usb/001/007") else (), True),
    )
    answering(monkeypatch, STATUS)
    found = looked(computer, capsys)
    assert found["daemon.runs"]["outcome"] == "ok"
    assert "port.holder" not in found
    answering(monkeypatch, STATUS | {"pid": 78})  # another one, and a stranger has the device
    found = looked(computer, capsys)
    assert "resonatord (pid 77)" in found["port.holder"]["evidence"]
    assert found["link.opens"]["outcome"] == "not_checked"


def test_a_daemon_that_is_well_has_nothing_wrong() -> None:
    assert set(judged().values()) == {Outcome.OK}


@pytest.mark.parametrize(
    ("change", "id", "outcome"),
    [
        ({"link": {"state": "lost", "reason": "x"}}, "daemon.link", Outcome.FAULT),
        ({"link": BUSY | {"state": "stalled"}}, "daemon.link", Outcome.NOT_CHECKED),
        ({"link": BUSY | {"state": "stalled"}}, "computer_busy", Outcome.FAULT),
        ({"link": BUSY | {"state": "online"}}, "daemon.link", Outcome.OK),
        ({"link": BUSY | {"state": "online"}}, "computer_busy", Outcome.FAULT),
        ({"link": {"state": "lost", "reason": "x"}, "sensor": {"state": "x"}}, "daemon.sensor", Outcome.NOT_CHECKED),
        ({"sensor": {"state": "pressed_at_start", "reason": "x"}}, "daemon.sensor", Outcome.FAULT),
        ({"sensor": {"state": "starting"}}, "daemon.sensor", Outcome.NOT_CHECKED),
        ({"sensor": {"state": "drifting"}}, "daemon.sensor", Outcome.WARNING),
        ({"sensor": {"state": "online", "reason_code": "fit_contradicted"}}, "daemon.sensor", Outcome.WARNING),
        ({"health": None}, "link.errors", Outcome.NOT_CHECKED),
        ({"health": {"boots": [{"frames": 9_995, "lost": {"damaged": 5}}]}}, "link.errors", Outcome.WARNING),
        ({"health": {"boots": [{"frames": 9_980, "lost": {"link_gap": 20}}]}}, "link.errors", Outcome.FAULT),
        ({"health": unplugged(20)}, "link.errors", Outcome.FAULT),
        ({"health": unplugged(0)}, "link.errors", Outcome.OK),
        ({"health": {"boots": [{"frames": 9_980, "lost": {"board_overflow": 20}}]}}, "link.errors", Outcome.OK),
        ({"health": {"boots": [{"frames": 9_980, "lost": {"board_overflow": 20}}]}}, "link.overflow", Outcome.FAULT),
        ({"health": {"boots": [{"frames": 9_995, "lost": {"board_overflow": 5}}]}}, "link.overflow", Outcome.WARNING),
        ({"health": unplugged(0, board_overflow=9)}, "link.overflow", Outcome.OK),
        ({"health": None}, "link.overflow", Outcome.NOT_CHECKED),
    ],
)
def test_what_a_daemon_says_is_judged(change: dict[str, object], id: str, outcome: Outcome) -> None:
    assert judged(**change)[id] is outcome


def test_a_silent_daemon_is_a_fault_unless_this_user_may_not_ask(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    socket = tmp_path / "status.sock"
    socket.touch()
    (finding,) = check_daemon(Answer(socket, None, "runs and gives no answer"))
    assert (finding.id, finding.outcome) == ("daemon.runs", Outcome.FAULT)
    monkeypatch.setattr("os.access", lambda _path, _mode: False)
    (finding,) = check_daemon(Answer(socket, None, "this user may not ask it"))
    assert finding.outcome is Outcome.NOT_CHECKED


def test_remedies_have_known_codes() -> None:
    assert STATE_REMEDIES.keys() <= {*Condition, *ReasonCode}
    assert all(" " in remedy for remedy in STATE_REMEDIES.values())  # no id of a check
