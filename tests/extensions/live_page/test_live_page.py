"""The live page of a broker: what browsers receive and may do, through its WebSocket."""

import asyncio
import hashlib
import json
import os
import re
import socket
import threading
import time
from contextlib import AsyncExitStack
from importlib import resources
from pathlib import Path
from typing import Any

import aiohttp
import brokers
import pytest
from brokers import Mosquitto, client_of
from emulation import emulated
from page_client import Browser, Frame, browser, served
from wire_host import opened, truths

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.commands import main
from resonator_daemon.extensions.live_page.hub import Sources
from resonator_daemon.extensions.live_page.protocol import WAITING_MAX, Outgoing
from simulators.emulator import EmulatorOptions

PAYLOAD = bytes(range(256)) * 100  # no JSON and no CBOR: nothing is decoded on the way


async def publish(broker: Mosquitto, path: str, payload: bytes | str, *, retain: bool = False) -> None:
    await brokers.publish(broker.url, f"resonator/{path}", payload, retain=retain)


def info(plate: str, serial_number: str = "EMU-0001", **more: Any) -> str:
    return json.dumps({"plate": plate, "serial_number": serial_number, **more})


async def test_a_second_tab_receives_the_same_and_each_watches_its_own_plate(mosquitto: Mosquitto) -> None:
    large = info("quartz16", sites=[{"id": number, "position_m": [0.0, 0.0]} for number in range(10_000)])
    await publish(mosquitto, "left/info", large, retain=True)
    async with served(Sources(Mqtt(url=mosquitto.url))) as url, browser(url) as first, browser(url) as second:
        hello = await first.key("hello")
        assert hello["sources"] == [{"source": "live", "url": mosquitto.url}]
        assert (hello["commands"], hello["press"]) == ([], [])
        for tab in (first, second):
            assert json.loads(await tab.frame("live/left/info")) == json.loads(large)
        assert (await first.watch("left", "decoded"))["ok"]
        assert (await second.watch("right", "decoded"))["ok"]
        await subscribed(mosquitto, first, "left/decoded")
        await subscribed(mosquitto, second, "right/decoded")
        await publish(mosquitto, "left/contacts/event", b"1")  # of a plate that the second does not watch, too
        await publish(mosquitto, "left/info", info("comb16"), retain=True)  # another plate, under the same name
        for tab in (first, second):
            assert await tab.frame("live/left/contacts/event") == b"1"
            assert json.loads(await tab.frame("live/left/info"))["plate"] == "comb16"
        await publish(mosquitto, "left/info", b"", retain=True)
        assert await second.frame("live/left/info") == b""
        assert (await first.key("clients", lambda it: it["count"] == 2))["skipped"] >= 0


async def subscribed(broker: Mosquitto, tab: Browser, path: str) -> None:
    """Publish until a stream reaches a browser, whose subscription takes a moment; check that it is as published."""
    async with client_of(broker.url) as client:
        while True:
            await client.publish(f"resonator/{path}", PAYLOAD)
            message = await tab.receive()
            if message is not None and not isinstance(message, dict) and message.address == f"live/{path}":
                assert message.payload == PAYLOAD
                return


async def test_a_browser_that_does_not_read_delays_nobody_and_misses_only_streams(mosquitto: Mosquitto) -> None:
    frames, size = 60, 1 << 20  # far more than buffers hold
    async with served(Sources(Mqtt(url=mosquitto.url))) as url, browser(url) as stalled, browser(url) as reading:
        await stalled.watch("left", "signals")
        await reading.watch("left", "signals")
        await subscribed(mosquitto, reading, "left/signals")
        async with client_of(mosquitto.url) as client:
            for number in range(frames):
                await client.publish("resonator/left/signals", bytes((number,)) * size)
                await reading.frame("live/left/signals", lambda it, number=number: it[0] == number and len(it) == size)
            await publish(mosquitto, "left/contacts/event", b"last")
        received = 0
        while True:  # it reads again: the event, and of the stream the newest
            message = await stalled.receive()
            assert message is not None
            if isinstance(message, dict):
                if message.get("clients", {}).get("skipped", 0) and received:
                    break
            else:
                received += message.address == "live/left/signals"
        assert 0 < received < frames // 2


async def test_a_browser_gets_20_maps_a_second_and_the_first_after_an_event_at_once(mosquitto: Mosquitto) -> None:
    async with served(Sources(Mqtt(url=mosquitto.url))) as url, browser(url) as tab, client_of(mosquitto.url) as client:
        await tab.watch("left", "decoded", "forces")
        await subscribed(mosquitto, tab, "left/forces")
        maps, began_s = 0, time.monotonic()
        for number in range(60):
            for path in ("decoded", "forces"):
                await client.publish(f"resonator/left/{path}", str(number))
            while (message := await tab.receive()) != Frame("live/left/forces", str(number).encode()):
                maps += isinstance(message, Frame) and message.address == "live/left/decoded"
        assert 0 < maps <= 2 + 20 * (time.monotonic() - began_s)
        await publish(mosquitto, "left/contacts/event", b"1")
        await tab.frame("live/left/contacts/event")
        await client.publish("resonator/left/decoded", "after")
        assert await tab.frame("live/left/decoded", lambda it: not it.isdigit()) == b"after"


async def test_a_queue_that_would_lose_more_than_streams_ends() -> None:
    outgoing = Outgoing()
    for number in range(WAITING_MAX):
        outgoing.put(str(number))
    assert await outgoing.get() == "0"
    for _ in range(2):
        outgoing.put("last")
    assert await outgoing.get() is None


async def test_a_broker_that_vanishes_and_returns_is_reported_by_codes(mosquitto: Mosquitto) -> None:
    for plate in ("left", "right"):
        await publish(mosquitto, f"{plate}/info", info("quartz16"), retain=True)
    async with served(Sources(Mqtt(url=mosquitto.url))) as url, browser(url) as tab:
        await tab.frame("live/left/info")
        await tab.watch("left", "forces")
        killed_ns = time.time_ns()
        await mosquitto.kill()
        gone = await tab.key("broker", lambda it: not it["connected"])
        assert gone["reason_code"] in ("connection_lost", "no_broker")
        assert killed_ns <= int(gone["since_t_ns"]) <= time.time_ns()
        await tab.key("broker", lambda it: it["reason_code"] == "no_broker")
        async with browser(url) as later:
            assert (await later.key("broker"))["since_t_ns"] == gone["since_t_ns"]
        await mosquitto.start()
        await publish(mosquitto, "right/info", info("comb16"), retain=True)  # again, as its daemon does
        await tab.frame("live/left/info", lambda payload: not payload)  # the broker has lost it
        await subscribed(mosquitto, tab, "left/forces")
        async with browser(url) as later:
            assert await later.frame("live/right/info")


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("garbage", "not_json"),
        ("[" * 50_000, "not_json"),
        ("[1]", "no_verb"),
        ({"watch": {}, "play": {}}, "no_verb"),
        ({"watch": 1}, "bad_value: watch: got 1"),
        ({"watch": {}}, "bad_value: watch.plate: got "),
        ({"watch": {"plate": "left", "colour": 1}}, "bad_value: watch.colour: got 1"),
        ({"watch": {"plate": "+"}}, "unknown_plate"),
        ({"watch": {"plate": "left", "topics": ["state/link"]}}, "bad_value"),
        ({"watch": {"plate": "left", "source": "a"}}, "unknown_source"),
        ('{"seek": {"source": "a", "t_s": NaN}}', "bad_value"),
        ({"play": {"source": "b", "playing": True}}, "unknown_source"),
        ({"command": {"plate": "left", "verb": "tare"}}, "read_only"),
        ({"press": {"plate": "left", "name": "a"}}, "not_pressable"),
    ],
)
async def test_a_bad_request_is_refused_by_a_code_and_ends_nothing(request_: object, code: str) -> None:
    async with served(Sources(Mqtt(url="mqtt://127.0.0.1:9"))) as url, browser(url) as tab:
        answer = await tab.ask(request_)
        assert not answer["ok"]
        assert f"{answer['error']['code']}: {answer['error']['message']}".startswith(code)
        assert (await tab.ask({"id": "x", "watch": {"plate": "left"}})) == {"id": "x", "ok": True}
        await tab.socket.send_bytes(b"\0")
        assert (await tab.key("answer"))["error"]["code"] == "not_json"


async def test_commands_are_those_of_the_list_and_for_plates_that_are_there(mosquitto: Mosquitto) -> None:
    await publish(mosquitto, "left/info", info("quartz16"), retain=True)
    async with served(Sources(Mqtt(url=mosquitto.url), allow_commands=True)) as url, browser(url) as tab:
        assert "tare" in (await tab.key("hello"))["commands"]
        await tab.frame("live/left/info")
        for plate, verb, code in (("left", "reload", "unknown_verb"), ("right", "tare", "unknown_plate")):
            assert await tab.refusal({"command": {"plate": plate, "verb": verb}}) == code
        async with client_of(mosquitto.url) as daemon:
            await daemon.subscribe("resonator/left/cmd/mark")
            mark = {"plate": "left", "verb": "mark", "arguments": {"text": "here"}}
            await tab.socket.send_json({"id": 7, "command": mark})
            async for message in daemon.messages:
                asked = json.loads(message.payload)
                assert asked["text"] == "here"
                content = {"ok": True, "verb": "mark", "id": asked["id"]}
                await daemon.publish(f"resonator/left/rsp/mark/{asked['id']}", json.dumps(content))
                break
        assert await tab.key("answer") == {"id": 7, "ok": True, "verb": "mark"}


async def test_a_browser_presses_an_emulated_plate_until_it_disconnects(mosquitto: Mosquitto, tmp_path: Path) -> None:
    control, board = tmp_path / "control", tmp_path / "board"
    sources = Sources(Mqtt(url=mosquitto.url), presses=[control])
    for plate, state, why in (("rep", "online", "replaying"), ("off", "offline", "stopped"), ("left", "online", "")):
        await publish(mosquitto, f"{plate}/info", info("quartz16"), retain=True)
        content = json.dumps({"state": state, "reason_code": why})
        await publish(mosquitto, f"{plate}/state/daemon", content, retain=True)
    press = {"plate": "left", "name": "mouse", "position_m": [-0.0005, 0.002], "force_newton": [0.0, 0.0, 1.5]}
    async with AsyncExitStack() as stack:
        stack.enter_context(emulated(EmulatorOptions("quartz16", pty=board, control=control, truth=tmp_path / "truth")))
        host = stack.enter_context(opened(board, 10_000_000))
        over = threading.Event()
        reading = asyncio.create_task(asyncio.to_thread(host.read_until, over.is_set))
        stack.push_async_callback(asyncio.wait, [reading])
        stack.callback(over.set)
        url = await stack.enter_async_context(served(sources))
        watching = await stack.enter_async_context(browser(url))
        await watching.watch("left", "forces")
        async with browser(url) as tab:
            await tab.key("hello", lambda it: it["press"] == ["left"])
            assert (await tab.ask({"id": 1, "press": press}))["ok"]
            assert await tab.refusal({"press": press | {"plate": "rep"}}) == "not_pressable"
            assert await tab.refusal({"press": press | {"position_m": [1.0, 0.0]}}) == "outside_plate"
            shown = await watching.key("truth", lambda it: it["contacts"])
            ((contact,),) = (shown["contacts"],)
            assert (contact["site"], contact["force_newton"]) == (7, [0.0, 0.0, 1.5])
        await watching.key("truth", lambda it: not it["contacts"])  # the other has disconnected
        middles = [int(line["t_ns"]) - 5_000_000 for line in truths(tmp_path / "truth")]  # a gate lasts 10 ms
        assert min(abs(middle - int(shown["t_ns"])) for middle in middles) < 3_000_000


async def test_who_may_open_the_page(mosquitto: Mosquitto) -> None:
    token = "0123456789abcdef"
    async with (
        served(Sources(Mqtt(url=mosquitto.url)), token=token) as url,
        aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session,
    ):
        port = url.rsplit(":", 1)[1].strip("/")

        async def status(**headers: str) -> tuple[int, str | None]:
            async with session.get(url, headers=headers) as response:
                assert "default-src 'none'" in response.headers["Content-Security-Policy"]
                # With no-referrer, browsers send `Origin: null` with the form of the token.
                assert response.headers["Referrer-Policy"] == "same-origin"
                is_json = response.content_type == "application/json"
                return response.status, (await response.json())["error"]["code"] if is_json else None

        assert await status() == (401, "no_token")
        assert await status(Host=f"evil.example:{port}") == (403, "wrong_host")
        assert await status(Host=f"evil@127.0.0.1:{port}") == (400, "bad_request")
        assert await status(Origin="http://evil.example") == (403, "wrong_origin")
        async with session.post(f"{url}login", data={"token": token}) as response:
            assert (response.status, response.url.path) == (200, "/")
        assert all(port in cookie.key for cookie in session.cookie_jar)  # the host's other ports have their own
        assert await status() == (200, None)  # by the cookie


def test_third_party_files_have_the_stated_hashes() -> None:
    folder = resources.files("resonator_daemon.extensions.live_page")
    stated = dict(re.findall(r"^\| `([\w./]+)` \|.*\| `([0-9a-f]{64})` \|$", (folder / "README.md").read_text(), re.M))
    files = [file for name in ("three", "uplot") for file in (folder / "page" / name).iterdir()]
    third_party = {f"{Path(str(file)).parent.name}/{file.name}": file for file in files if file.name != "LICENSE"}
    assert len(files) == len(third_party) + 2
    assert {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in third_party.items()} == stated


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--listen", "0.0.0.0:0"], ExitCode.USAGE),
        (["--tls-key", "key.pem"], ExitCode.USAGE),
        (["--token-file", "short"], ExitCode.CONFIG),
        (["--token-file", "missing"], ExitCode.CONFIG),
        (["--listen", "127.0.0.1:{taken}"], ExitCode.FAILED),
        (["missing.mcap"], ExitCode.USAGE),
        (["missing.mcap", "--url", "mqtt://127.0.0.1"], ExitCode.USAGE),
        ([".", "--allow-commands"], ExitCode.USAGE),
        ([".", "missing.mcap"], ExitCode.USAGE),
        (["--press", "short"], ExitCode.USAGE),
    ],
)
def test_a_page_that_cannot_be_served_ends_with_its_exit_code(
    words: list[str], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("short").write_text("abc\n")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", "--json", *(word.format(taken=port) for word in words)]) == code
    answer = json.loads(capsys.readouterr().out)
    assert (answer["verb"], answer["ok"]) == ("view", False)
    assert "password" not in answer["error"]["message"]
    assert os.listdir(tmp_path) == ["short"]
