"""README and tutorials: their commands work in the order in which they stand; README's lines and words are few."""

import asyncio
import os
import re
import shlex
import sys
from asyncio.subprocess import Process
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from brokers import Mosquitto
from decoder_bench import until

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
TUTORIALS = ROOT / "docs" / "tutorials"
PROGRAM = str(Path(sys.executable).parent / "resonatord")
LINES_MAX, WORDS_MAX = 120, 900
ONLINE = "left-index: daemon online   link online   sensor online"
BOARD = ["emulate", "--plate", "quartz16", "--pty", "/tmp/board", "&"]


def commands(text: str) -> list[list[str]]:
    """Return the words after `.venv/bin/resonatord` of each command in a text, without comments."""
    lines = re.findall(r"^    \.venv/bin/resonatord (.*)", text, re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


class Shell:
    """Runs commands in a folder, with a broker and a place for the port of their own."""

    def __init__(self, folder: Path, mosquitto: Mosquitto) -> None:
        self._folder = folder
        self._broker = mosquitto.url
        self._environment = os.environ | {"XDG_STATE_HOME": f"{folder}/state", "XDG_RUNTIME_DIR": f"{folder}/run"}
        self._running: list[Process] = []
        (folder / "run").mkdir()

    async def run(self, words: list[str]) -> None:
        """Run one command as a user would; one that goes on until it is stopped as far as it is ready."""
        words = [word.replace("/tmp/board", f"{self._folder}/board") for word in words]
        verb = words[0]
        if verb in ("emulate", "run", "watch"):
            url = ("--url", self._broker) if verb == "watch" else ()
            process = await self.start(PROGRAM, *(word for word in words if word != "&"), *url)
            if verb == "emulate":
                await until((self._folder / "board").exists)
            elif verb == "watch":
                await has_line(process, ONLINE)
            return
        process = await self.start(PROGRAM, *(words[: words.index(">")] if ">" in words else words))
        output = (await process.communicate())[0].decode()
        assert process.returncode == 0, (verb, output)
        if ">" in words:
            text = re.sub(r'(?m)^link = "[^"]*"', f'link = "serial:{self._folder}/board?baud=4000000"', output)
            (self._folder / words[-1]).write_text(text.replace("mqtt://127.0.0.1:1883", self._broker))

    async def start(self, *words: str) -> Process:
        process = await asyncio.create_subprocess_exec(
            *words, cwd=self._folder, env=self._environment, stdout=asyncio.subprocess.PIPE
        )
        self._running.append(process)
        return process

    async def stop(self) -> None:
        for process in reversed(self._running):
            if process.returncode is None:
                process.terminate()
                await process.communicate()


@pytest.fixture
async def shell(tmp_path: Path, mosquitto: Mosquitto) -> AsyncIterator[Shell]:
    shell = Shell(tmp_path, mosquitto)
    try:
        yield shell
    finally:
        await shell.stop()


def test_lines_and_words_are_few() -> None:
    assert [line for line in README.splitlines() if len(line) > LINES_MAX] == []
    assert len(README.split()) <= WORDS_MAX


@pytest.mark.parametrize(
    ("page", "verbs"),
    [
        (README.partition("## Connect a board")[2], "emulate ports identify config check run watch status doctor"),
        ((TUTORIALS / "first-board.md").read_text(), "ports identify config check run watch doctor"),
    ],
    ids=["README", "first-board"],
)
async def test_a_board_is_connected_by_the_commands_of(page: str, verbs: str, shell: Shell) -> None:
    found = commands(page)
    assert [words[0] for words in found] == verbs.split()
    for words in found if found[0][0] == "emulate" else [BOARD, *found]:
        await shell.run(words)


async def test_the_first_press_is_read_from_mqtt(shell: Shell, tmp_path: Path, mosquitto: Mosquitto) -> None:
    page = (TUTORIALS / "first-press.md").read_text()
    (scenario,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "press.toml").write_text(scenario)
    for words in commands(page):
        await shell.run(words)
    (program,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    reader = await shell.start(sys.executable, "-c", program.replace("mqtt://127.0.0.1:1883", mosquitto.url))
    async with asyncio.timeout(30):
        lines = (await reader.communicate())[0].decode().splitlines()
    *_, last = lines
    assert last.startswith("left-index release at site 7 peak ")
    assert float(last.split()[-2]) == pytest.approx(2.0, rel=0.05)


async def has_line(process: Process, begin: str) -> None:
    """Wait for a line of the process's output that begins so."""
    assert process.stdout is not None
    async with asyncio.timeout(30):
        while not (await process.stdout.readline()).decode().startswith(begin):
            assert process.returncode is None
