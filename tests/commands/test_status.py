"""`resonatord status` with daemons that answer, hang, refuse, or are not there."""

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest
import status_samples
from status_samples import listens

from resonator_daemon.base.host import files as places
from resonator_daemon.base.host.files import runtime_directory
from resonator_daemon.commands import main
from resonator_daemon.daemon.monitoring import status_client
from resonator_daemon.daemon.monitoring.status import BrokerStatus, ConfigStatus, Status
from resonator_daemon.daemon.monitoring.status_server import SOCKET_NAME, StatusServer
from resonator_daemon.mqtt.payloads import Condition

DEADLINE_S = 20.0


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only place where daemons are."""
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    home = runtime_directory("x").parent
    for module in (status_client, places):
        monkeypatch.setattr(module, "runtime_directories", lambda: (home,))
    monkeypatch.setenv("COLUMNS", "200")
    return home


@asynccontextmanager
async def daemons(*statuses: Status) -> AsyncIterator[None]:
    async with AsyncExitStack() as stack, asyncio.timeout(DEADLINE_S):
        for status in statuses:
            path = runtime_directory(status.instance) / SOCKET_NAME
            task = asyncio.create_task(StatusServer(path, Path("hand.toml"), lambda status=status: status).run())
            stack.push_async_callback(asyncio.wait, [task])
            stack.callback(task.cancel)
            while not listens(path):  # noqa: ASYNC110 - a socket that is not there yet has no event
                await asyncio.sleep(0.001)
        yield


async def run(*arguments: str) -> int:
    return await asyncio.to_thread(main, ["status", *arguments])


def listening(home: Path, instance: str) -> socket.socket:
    """Return a socket that takes connections in and never answers."""
    (home / instance).mkdir(parents=True)
    silent = socket.socket(socket.AF_UNIX)
    silent.bind(str(home / instance / SOCKET_NAME))
    silent.listen()
    return silent


@pytest.mark.parametrize("name", ["left-index", "hand", "etc/hand.toml"])
async def test_one_of_many_by_its_name_or_its_files(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    async with daemons(status_samples.status(), status_samples.status(instance="foot", name="sole")):
        assert await run(name, "--json") == 0
        printed = json.loads(capsys.readouterr().out)
        assert await run("nobody") == 1
    assert [daemon["instance"] for daemon in printed["daemons"]] == ["hand"]
    assert Status.model_validate_json(json.dumps(printed["daemons"][0])) == status_samples.status()
    assert "no daemon called nobody runs" in capsys.readouterr().err


async def test_one_that_is_stopped_is_reported_beside_the_others(
    home: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(status_client, "ANSWER_S", 0.2)
    with listening(home, "asleep"):
        async with daemons(status_samples.status()):
            assert await run() == 1
            page = capsys.readouterr().out
            assert await run("--json") == 1
            printed = json.loads(capsys.readouterr().out)
            assert await run("hand") == 0
    assert page.startswith("asleep   runs and gives no answer within 0.2 s: is it stopped")
    assert "left-index   process 4711" in page
    assert [problem["socket"] for problem in printed["problems"]] == [str(home / "asleep" / SOCKET_NAME)]
    assert [daemon["instance"] for daemon in printed["daemons"]] == ["hand"]


@pytest.mark.parametrize(
    ("answer", "printed", "code"),
    [
        (b"", "is no status", 1),
        (b"\xff\xfe", "is no status", 1),
        (b"[" * 100_000, "is no status", 1),
        (b"[]", "is no status", 1),
        (b'{"version": "9.9\\u001b[31m", "name": 5}', "version 9.9\N{REPLACEMENT CHARACTER}[31m sends a status", 0),
    ],
)
async def test_an_answer_that_cannot_be_read_is_reported(
    home: Path, capsys: pytest.CaptureFixture[str], answer: bytes, printed: str, code: int
) -> None:
    async def give(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(answer)
        writer.close()

    (home / "odd").mkdir(parents=True)
    async with await asyncio.start_unix_server(give, home / "odd" / SOCKET_NAME):
        assert await run() == code
    page = capsys.readouterr().out
    assert page.startswith("odd   ")
    assert printed in page
    assert "\x1b" not in page


async def test_what_is_not_well_is_in_the_block(capsys: pytest.CaptureFixture[str]) -> None:
    config = ConfigStatus(
        file="/etc/hand.toml",
        in_use="last_good",
        problems=("hand.toml:3: link: missing", "hand.toml:4: nmae: unknown key"),
        loaded_t_ns=status_samples.NOW_NS,
        needs_restart=("link", "mqtt.url"),
    )
    link = status_samples.state(
        Condition.LOST, "unplugged\x1b[2J\u202e", boot_count=2, last_outage=status_samples.outage()
    )
    status = status_samples.status(
        config=config,
        link=link,
        broker=BrokerStatus(url="mqtt://robot:1883", connected=False),
        recording=status_samples.RECORDING.model_copy(update={"failure": "no room"}),
    )
    async with daemons(status):
        assert await run() == 0
    page = capsys.readouterr().out
    for words in (
        "lost: unplugged\N{REPLACEMENT CHARACTER}[2J\N{REPLACEMENT CHARACTER} (for ",
        "; 2 boots of the board; ",
        " ago 1.5 s without frames, 1 500 lost: unplugged",
        "mqtt://robot:1883, not connected",
        "stopped: no room",
        "the last good one, read ",
        "/etc/hand.toml has problems:",
        "hand.toml:4: nmae: unknown key",
        "restart for what has changed: link, mqtt.url",
        "link gap 1, damaged 2",
        "61 sent, 80 waiting (36 of them on disk); dropped: 32 no connection, 33 spool full",
        "12.5 % of a core, 96 MB, 20 file descriptors, 19 threads",
    ):
        assert words in page
    assert str(status_samples.NOW_NS)[:10] not in page
    assert "\x1b" not in page
