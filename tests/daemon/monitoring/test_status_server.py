"""The socket that tells how the daemon is: one answer to each, whoever else is there and whatever they do."""

import asyncio
import json
import os
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
import status_samples
from observer import logged_once, running_task, until
from status_samples import listens

from resonator_daemon.daemon.monitoring.status import Status
from resonator_daemon.daemon.monitoring.status_server import (
    PATH_BYTES_MAX,
    AlreadyRunningError,
    StatusServer,
    StatusTimes,
)

DEADLINE_S = 20.0
CONFIG = Path("hand.toml")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "status.sock"


@asynccontextmanager
async def serving(
    path: Path, make: Callable[[], Status] = status_samples.status, **times: float
) -> AsyncIterator[None]:
    async with running_task(StatusServer(path, CONFIG, make, StatusTimes(**times)).run()):
        yield


async def ask(path: Path) -> bytes:
    async with asyncio.timeout(DEADLINE_S):
        reader, writer = await asyncio.open_unix_connection(path)
        try:
            return await reader.read(-1)
        finally:
            writer.close()


async def test_what_a_killed_daemon_left_is_replaced(path: Path) -> None:
    path.parent.mkdir()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    path.with_suffix(".lock").touch()
    async with serving(path):
        await until(lambda: listens(path))
        assert json.loads(await ask(path))["instance"] == "hand"


OTHER_DAEMON = """
import asyncio, sys
sys.path.insert(0, sys.argv[2])
import status_samples
from pathlib import Path
from resonator_daemon.daemon.monitoring.status_server import StatusServer
path, config = map(Path, (sys.argv[1], sys.argv[3]))
asyncio.run(StatusServer(path, config, lambda: status_samples.status(instance="other")).run())
"""


async def test_a_running_daemons_socket_is_not_taken_before_it_ends(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tests, config = Path(__file__).parents[2] / "support", Path("other/hand.toml")
    with subprocess.Popen([sys.executable, "-c", OTHER_DAEMON, str(path), str(tests), str(config)]) as other:
        try:
            await until(lambda: path.exists() and listens(path))
            second = StatusServer(path, config, status_samples.status)
            with pytest.raises(AlreadyRunningError, match=f"^process {other.pid} runs with this configuration"):
                second.run().send(None)  # before it waits for anything
            assert not second.may_begin.is_set()
            async with serving(path, retry_s=0.001):
                assert f"process {other.pid}" in await logged_once(caplog, 0.001)
                assert json.loads(await ask(path))["instance"] == "other"
                other.kill()
                await until(lambda: other.poll() is not None)
                await until(lambda: listens(path))
                assert json.loads(await ask(path))["instance"] == "hand"
        finally:
            other.kill()


async def test_a_path_too_long_for_sockets_is_reported_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    room = PATH_BYTES_MAX - len(os.fsencode(tmp_path)) - len("//status.sock")
    path = tmp_path / ("é" * (room // 2) + "e" * (room % 2 + 1)) / "status.sock"
    async with serving(path, retry_s=0.001):
        assert "has 108 bytes, and sockets take 107 at most; give" in await logged_once(caplog, 0.001)


@pytest.mark.parametrize("name", ["run", "run/status.sock"])
@pytest.mark.parametrize("link", [False, True])
async def test_what_is_in_the_way_is_left_alone_and_logged_once(
    tmp_path: Path, path: Path, caplog: pytest.LogCaptureFixture, name: str, link: bool
) -> None:
    in_the_way = tmp_path / name
    in_the_way.parent.mkdir(exist_ok=True)
    if link:
        in_the_way.symlink_to(tmp_path / "nowhere")
    else:
        in_the_way.write_text("kept")
    async with serving(path, retry_s=0.001):
        assert str(in_the_way) in await logged_once(caplog, 0.001)
        assert in_the_way.is_symlink() if link else in_the_way.read_text() == "kept"
        assert not (tmp_path / "nowhere").exists()
        in_the_way.unlink()
        await until(lambda: listens(path))


async def test_one_who_never_reads_a_huge_answer_is_left(path: Path) -> None:
    huge = status_samples.status(version="x" * 3_000_000)
    async with serving(path, lambda: huge, send_s=1.0):
        await until(lambda: listens(path))
        with socket.socket(socket.AF_UNIX) as hanging:
            hanging.connect(str(path))
            answer = await ask(path)
    assert json.loads(answer)["version"] == huge.version


@pytest.mark.parametrize("lost", ["directory", "socket", "lock"])
async def test_a_socket_or_lock_that_is_removed_is_made_again_and_reported_once(
    path: Path, caplog: pytest.LogCaptureFixture, lost: str
) -> None:
    async with serving(path, check_s=0.001):
        await until(lambda: listens(path))
        before = path.stat().st_ino, path.with_suffix(".lock").stat().st_ino
        gone = {"directory": path.parent, "socket": path, "lock": path.with_suffix(".lock")}[lost]
        gone.rename(gone.parent / "moved")  # not removed: a new file must not get the number of an old one
        await until(lambda: "made again" in caplog.text)
        await until(lambda: path.exists() and listens(path))
        assert (await ask(path)).endswith(b"}\n")
        assert (path.stat().st_ino, path.with_suffix(".lock").stat().st_ino) != before
        assert await logged_once(caplog, 0.001) == f"{path} or its lock was removed or replaced: made again"
    assert not path.exists()


async def test_the_socket_of_a_daemon_that_came_after_a_removal_stays(path: Path) -> None:
    async with serving(path):
        await until(lambda: listens(path))
        path.parent.rename(path.parents[1] / "moved")
        path.parent.mkdir()
        with socket.socket(socket.AF_UNIX) as other:
            other.bind(str(path))
    assert path.is_socket()
