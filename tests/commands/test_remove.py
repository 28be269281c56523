"""`resonatord remove` as a user meets it: what was cleared, or why nothing was."""

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from urllib.parse import urlsplit

import aiomqtt
import pytest
from brokers import Mosquitto, free_port
from command_line import exit_code

Printed = tuple[int | None, str, str]  # exit code, stdout and stderr
Remove = Callable[..., Awaitable[Printed]]


@pytest.fixture
def remove(capsys: pytest.CaptureFixture[str]) -> Remove:
    """`remove` in a thread of this process."""

    async def run(*arguments: object) -> Printed:
        code = await asyncio.to_thread(exit_code, "remove", *arguments)
        return code, *capsys.readouterr()

    return run


async def retain(url: str, **states: str) -> None:
    """Retain `state/daemon` and `info` of plates with these states."""
    at = urlsplit(url)
    async with aiomqtt.Client(at.hostname or "", at.port or 1883) as client:
        for name, state in states.items():
            await client.publish(f"lab/one/{name}/state/daemon", json.dumps({"state": state}), qos=1, retain=True)
            await client.publish(f"lab/one/{name}/info", b"{}", qos=1, retain=True)


async def test_what_was_cleared_is_printed(mosquitto: Mosquitto, tmp_path: Path, remove: Remove) -> None:
    await retain(mosquitto.url, left="offline", right="offline")
    code, printed, reported = await remove("left", "--url", mosquitto.url, "--prefix", "lab/one")
    assert (code, reported) == (0, "")
    assert "info, state/daemon" in printed
    config = tmp_path / "board.toml"
    config.write_text(f'name = "right"\n[mqtt]\nurl = "{mosquitto.url}"\nprefix = "lab/two"\n')
    code, printed, reported = await remove(config, "--prefix", "lab/one", "--json")
    assert (code, reported) == (0, "")
    assert json.loads(printed) == {"verb": "remove", "ok": True, "name": "right", "removed": ["info", "state/daemon"]}


async def test_every_failure_has_its_code(mosquitto: Mosquitto, remove: Remove) -> None:
    await retain(mosquitto.url, left="online")
    nobody = f"mqtt://127.0.0.1:{free_port()}"
    there = "--prefix", "lab/one", "--url", mosquitto.url
    codes = []
    for arguments in (
        ("left", *there),
        ("right", *there),
        ("left", "--url", nobody),
        ("decoder", *there),
        ("a/b", *there),
        ("+", *there),
    ):
        code, printed, reported = await remove(*arguments, "--json")
        answer = json.loads(printed)
        assert (answer["verb"], answer["ok"]) == ("remove", False)
        assert reported == f"resonatord: {answer['error']['message']}\n"
        assert "mqtt.url" not in reported
        codes.append((code, answer["error"]["code"]))
    assert codes == [(1, "not_offline"), (1, "no_plate"), (69, "no_broker")] + 3 * [(2, "usage")]
    code, printed, _ = await remove("left", *there, "--force", "--json")
    assert (code, json.loads(printed)["removed"]) == (0, ["info", "state/daemon"])
