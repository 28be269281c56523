"""`resonatord tare` as a user meets it: what the daemon did, or why it did not."""

import asyncio
import json
import sys
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from brokers import Mosquitto, free_port

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing.commands import CommandRefusedError, Handler, Respond
from resonator_daemon.publishing.payloads import CalibrationInfo, Info, Lost, State
from resonator_daemon.publishing.publisher import Publisher
from resonator_daemon.publishing.topics import INFO, STATE_DAEMON

TIMEOUT_S = 60
HEADER: dict[str, Any] = {"seq": 0, "daemon_boot_id": "9f3c", "board_boot_id": "51aa", "t_ns": 1, "t_unc_ns": 1}
HEADER["lost"] = Lost()
LINK = "tcp://127.0.0.1:9"


async def tare(folder: Path, url: str, *arguments: str, name: str = 'name = "left"') -> tuple[int | None, str, str]:
    config = folder / "board.toml"
    config.write_text(f'{name}\nplate = "quartz16"\nlink = "{LINK}"\n[mqtt]\nurl = "{url}"\n')
    command = (sys.executable, "-m", "resonator_daemon.cli", "tare", "--config", str(config), *arguments)
    process = await asyncio.create_subprocess_exec(*command, stdout=PIPE, stderr=PIPE)
    async with asyncio.timeout(TIMEOUT_S):
        said, told = await process.communicate()
    assert b"Traceback" not in told
    return process.returncode, said.decode(), told.decode()


@asynccontextmanager
async def daemon(url: str, handler: Handler, name: str = "left") -> AsyncIterator[None]:
    """As much of a daemon as a command needs."""

    def state(condition: str, reason: str) -> State:
        return State(**HEADER, state=condition, reason=reason, since_t_ns=None)

    publisher = Publisher(Mqtt(url=url), name, lambda reason: state("offline", reason), handler)
    publisher.publish(STATE_DAEMON, state("online", "measuring"))
    publisher.publish(
        INFO,
        Info(
            **HEADER,
            daemon_version="0",
            plate="quartz16",
            link=LINK,
            serial_number=name,
            frame_rate_hz=1000.0,
            window_s=0.01,
            step_s=0.005,
            force_max_newton=10.0,
            outline_m=(),
            sites=(),
            calibration=CalibrationInfo(
                id=None, date=None, unit=None, expiry=None, model_error=0.015, sensitivity_std=0.0, response="off"
            ),
        ),
    )
    running = asyncio.create_task(publisher.run())
    yield
    await publisher.close(wait_for_broker=True)
    await running


def tared(verb: str, payload: dict[str, Any], respond: Respond) -> None:
    assert (verb, payload) == ("tare", {})
    respond({"ok": True, "did": "common mode taken as untouched", "common_mode": [1e-6, None, None, None]})


def touched(*_: object) -> None:
    raise CommandRefusedError("not_untouched", "site 7 is touched", "release it")


async def test_what_the_daemon_did_is_printed(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async with daemon(mosquitto.url, tared):
        assert await tare(tmp_path, mosquitto.url) == (0, "common mode taken as untouched\n", "")
        code, said, _ = await tare(tmp_path, mosquitto.url, "--json")
    assert code == 0
    assert json.loads(said) == {
        "verb": "tare",
        "ok": True,
        "did": "common mode taken as untouched",
        "common_mode": [1e-6, None, None, None],
    }


async def test_a_refusal_is_told_and_fails(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async with daemon(mosquitto.url, touched):
        code, said, told = await tare(tmp_path, mosquitto.url)
    assert (code, said) == (1, "")
    assert told == "resonatord: not tared: site 7 is touched; release it\n"


def silent(*_: object) -> None:
    """A command that nobody answers."""


async def test_an_offline_daemon_is_not_asked(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async with daemon(mosquitto.url, silent):
        pass
    for name in ('name = "left"', ""):
        code, said, told = await tare(tmp_path, mosquitto.url, name=name)
        assert (code, said) == (1, "")
        assert told == "resonatord: daemon left is offline (stopped); start it: resonatord run\n"
    code, said, told = await tare(tmp_path, mosquitto.url, "--json")
    assert code == 1
    error = {"code": "no_daemon", "message": "daemon left is offline (stopped); start it: resonatord run", "hint": ""}
    assert json.loads(said) == {"verb": "tare", "ok": False, "error": error}
    async with daemon(mosquitto.url, tared):  # and again as soon as it is back
        assert (await tare(tmp_path, mosquitto.url))[0] == 0


async def test_a_daemon_that_was_never_there_is_told(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async with daemon(mosquitto.url, tared, name="right"):
        code, said, told = await tare(tmp_path, mosquitto.url)
    assert (code, said) == (1, "")
    assert told == "resonatord: no daemon publishes as resonator/left; start it\n"


async def test_every_failure_is_an_object(mosquitto: Mosquitto, tmp_path: Path) -> None:
    port = free_port()
    url = f"mqtt://127.0.0.1:{port}"
    codes = []
    for place, name in ((url, ""), (mosquitto.url, ""), (mosquitto.url, "nam = 1")):
        code, said, told = await tare(tmp_path, place, "--json", name=name)
        answer = json.loads(said)
        assert (answer["verb"], answer["ok"]) == ("tare", False)
        assert told == f"resonatord: {answer['error']['message']}\n"
        codes.append((code, answer["error"]["code"]))
    async with daemon(mosquitto.url, touched):
        code, said, _ = await tare(tmp_path, mosquitto.url, "--json")
    codes.append((code, json.loads(said)["error"]["code"]))
    assert codes == [(69, "no_broker"), (1, "no_daemon"), (78, "config"), (1, "not_untouched")]


async def test_without_a_name_the_daemon_is_found_by_its_link(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async with daemon(mosquitto.url, tared, name="EMU-0001"):
        code, said, _ = await tare(tmp_path, mosquitto.url, name="")
    assert (code, said) == (0, "common mode taken as untouched\n")


async def test_of_daemons_of_one_link_the_one_that_runs_is_asked(mosquitto: Mosquitto, tmp_path: Path) -> None:
    async with daemon(mosquitto.url, touched, name="a-board-before"):
        pass
    async with daemon(mosquitto.url, tared, name="EMU-0001"):
        assert (await tare(tmp_path, mosquitto.url, name=""))[0] == 0


async def test_no_broker(tmp_path: Path) -> None:
    port = free_port()
    code, said, told = await tare(tmp_path, f"mqtt://127.0.0.1:{port}")
    assert (code, said) == (69, "")
    assert f"no broker at 127.0.0.1:{port}" in told
