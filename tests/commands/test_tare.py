"""`resonatord tare` and `command` as a user meets them: what the daemon did, or why it did not."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from types import MappingProxyType

import pytest
from brokers import Mosquitto, free_port
from command_line import exit_code
from commanded import commanded, state

from resonator_daemon.commands import main
from resonator_daemon.mqtt import requests
from resonator_daemon.mqtt.commands import CommandRefusedError, Handler
from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.payloads import Info
from resonator_daemon.mqtt.topics import INFO, STATE_DAEMON
from resonator_daemon.mqtt.verbs import Mark, MarkAnswer, SetWindow, SetWindowAnswer, Tare, TareAnswer

LINK = "tcp://127.0.0.1:9"


Printed = tuple[int | None, str, str]  # exit code, stdout and stderr
Ask = Callable[..., Awaitable[Printed]]


def write_config(folder: Path, url: str, name: str = 'name = "left"') -> str:
    config = folder / "board.toml"
    config.write_text(f'{name}\nplate = "quartz16"\nlink = "{LINK}"\n[mqtt]\nurl = "{url}"\n')
    return str(config)


@pytest.fixture
def tare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Ask:
    """`tare` at a broker, in a thread of this process."""

    async def ask(url: str, *arguments: str, name: str = 'name = "left"') -> Printed:
        code = await asyncio.to_thread(main, ["tare", "--config", write_config(tmp_path, url, name), *arguments])
        return code, *capsys.readouterr()

    return ask


@asynccontextmanager
async def daemon(
    url: str,
    handler: Handler,
    name: str = "left",
    allowed: Collection[str] = ("tare",),
    more: Mapping[str, Handler] = MappingProxyType({}),
) -> AsyncIterator[None]:
    async with commanded(url, {"tare": handler, **more}, allowed, name) as running:
        running.publisher.publish(running.base, STATE_DAEMON, state("online", "measuring"))
        info = Info.model_validate({**EXAMPLES["Info"], "link": LINK, "serial_number": name})
        running.publisher.publish(running.base, INFO, info)
        while running.publisher.account.waiting:  # noqa: ASYNC110 - the publisher offers no event for it
            await asyncio.sleep(0.001)
        yield


def tared(_: Tare) -> TareAnswer:
    return TareAnswer(message="common mode taken as untouched", common_mode=(1e-6, *[float("nan")] * 3))


def touched(_: Tare) -> TareAnswer:
    raise CommandRefusedError("not_untouched", "site 7 is touched", "release it")


async def test_the_answer_is_printed(mosquitto: Mosquitto, tare: Ask, capsys: pytest.CaptureFixture[str]) -> None:
    async with daemon(mosquitto.url, tared):
        assert await tare(mosquitto.url) == (0, "common mode taken as untouched\n", "")
        assert await asyncio.to_thread(exit_code, "tare", "left", "--url", mosquitto.url, "--json") == 0
        printed = capsys.readouterr().out
    answer = json.loads(printed)
    del answer["id"]
    assert answer == {
        "verb": "tare",
        "ok": True,
        "message": "common mode taken as untouched",
        "common_mode": [1e-6, None, None, None],
    }


async def test_an_offline_daemon_is_not_asked(mosquitto: Mosquitto, tare: Ask) -> None:
    async with daemon(mosquitto.url, tared):
        pass
    for name in ('name = "left"', ""):
        code, printed, reported = await tare(mosquitto.url, "--json", name=name)
        error = {"code": "no_daemon", "message": reported.removeprefix("resonatord: ").rstrip(), "hint": ""}
        assert (code, json.loads(printed)) == (1, {"verb": "tare", "ok": False, "error": error})
        assert "daemon left is offline (stopped)" in reported
    async with daemon(mosquitto.url, tared):  # and again as soon as it is back
        assert (await tare(mosquitto.url))[0] == 0


async def test_every_failure_is_an_object(mosquitto: Mosquitto, tare: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    url = f"mqtt://127.0.0.1:{port}"
    codes = []
    for place, name in ((url, ""), (mosquitto.url, ""), (mosquitto.url, 'name = "left"\nmetrics.listen = 1')):
        with monkeypatch.context() as patch:
            patch.setattr(requests, "LOOK_S", 0.3)
            code, printed, reported = await tare(place, "--json", name=name)
        answer = json.loads(printed)
        assert (answer["verb"], answer["ok"]) == ("tare", False)
        assert reported == f"resonatord: {answer['error']['message']}\n"
        codes.append((code, answer["error"]["code"]))
    async with daemon(mosquitto.url, touched):
        code, printed, _ = await tare(mosquitto.url, "--json", "--wait", "0")
    codes.append((code, json.loads(printed)["error"]["code"]))
    assert codes == [(69, "no_broker"), (1, "no_daemon"), (78, "config"), (1, "not_untouched")]


async def test_it_waits_for_the_first_untouched_reading(mosquitto: Mosquitto, tare: Ask) -> None:
    refusals = [CommandRefusedError("not_ready", "no reading yet"), CommandRefusedError("not_untouched", "touched")]

    def handler(request: Tare) -> TareAnswer:
        if refusals:
            raise refusals.pop(0)
        return tared(request)

    async with daemon(mosquitto.url, handler):
        code, printed, noted = await tare(mosquitto.url, "--wait", "30")
    assert (code, printed) == (0, "common mode taken as untouched\n")
    assert noted == "no reading yet; waiting up to 30 s for an untouched reading\n"


@pytest.mark.parametrize("target", [("left",), ("board.toml",)])
async def test_any_command_is_sent_with_its_fields(
    target: tuple[str, ...],
    mosquitto: Mosquitto,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_config(tmp_path, mosquitto.url)
    marks: list[str] = []

    def mark(request: Mark) -> MarkAnswer:
        marks.append(request.text)
        return MarkAnswer(t_ns=17)

    def set_window(request: SetWindow) -> SetWindowAnswer:
        return SetWindowAnswer(window_s=1e-3 * (request.window_ms or 0), step_s=0.005)

    async def command(*words: str) -> Printed:
        where = () if target[0].endswith(".toml") else ("--url", mosquitto.url)
        code = await asyncio.to_thread(exit_code, "command", *target, words[0], *where, *words[1:])
        return code, *capsys.readouterr()

    async with daemon(
        mosquitto.url, tared, allowed=("mark", "set_window"), more={"mark": mark, "set_window": set_window}
    ):
        assert await command("mark", "text=5") == (0, 't_ns: "17"\n'.replace('"', ""), "")
        code, printed, _ = await command("set_window", "window_ms=20", "--json")
        assert (code, json.loads(printed)["window_s"]) == (0, 0.02)
        code, printed, reported = await command("tare")
        assert (code, printed, reported.startswith("resonatord: tare not done: ")) == (1, "", True)
        code, printed, _ = await command("mark", "--json")
        assert (code, json.loads(printed)["error"]["code"]) == (1, "payload")
        for wrong in (("tear",), ("mark", "text")):
            assert (await command(*wrong))[0] == 2
    assert marks == ["5"]


async def test_without_a_name_the_daemon_is_found_by_its_link(mosquitto: Mosquitto, tare: Ask) -> None:
    async with daemon(mosquitto.url, tared, name="EMU-0001"):
        code, printed, _ = await tare(mosquitto.url, name="")
    assert (code, printed) == (0, "common mode taken as untouched\n")
