"""README, tutorials and how-to guides: their commands work in the order in which they stand."""

import asyncio
import json
import re
import shutil
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from brokers import Mosquitto
from documented_commands import BOARD, Shell, commands

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
TUTORIALS = ROOT / "docs" / "tutorials"
LINES_MAX, WORDS_MAX = 120, 900
GUIDES = ROOT / "docs" / "how-to"
# Commands of guides that need what a test has not, by a part of them, and what that is.
ELSEWHERE = {
    "mqtt://robot:1883": "another computer",
    "decode-recordings": "recordings of a fleet",
    "tcp://192.168.7.2": "a board in a network",
}


@pytest.fixture
async def shell(tmp_path: Path, mosquitto: Mosquitto) -> AsyncIterator[Shell]:
    shell = Shell(tmp_path, mosquitto.url)
    try:
        yield shell
    finally:
        await shell.stop()


def test_lines_and_words_are_few() -> None:
    assert [line for line in README.splitlines() if len(line) > LINES_MAX] == []
    assert len(README.split()) <= WORDS_MAX


async def test_a_board_is_connected_by_the_commands_of_the_readme(shell: Shell) -> None:
    found = commands(README.partition("## Connect a board")[2])
    verbs = ["emulate", "ports", "identify", "config", "check", "run", "watch", "status", "doctor"]
    assert [words[0] for words in found] == verbs
    for words in found:
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


async def test_the_guides_work_in_turn(shell: Shell, tmp_path: Path) -> None:
    async def work_through(*guides: str) -> list[str]:
        pages = [(GUIDES / f"{guide}.md").read_text() for guide in guides]
        return [part for page in pages for part in await shell.run_all(page, ELSEWHERE)]

    async def request(*words: str) -> str:
        return await shell.run(["command", "left-index.toml", *words, "--json"])

    await shell.run(BOARD)
    await shell.run(["config", "example", "--link", "serial:/tmp/board?baud=4000000", ">", "left-index.toml"])
    configuration = tmp_path / "left-index.toml"
    allowed = 'allow = ["start_recording", "stop_recording", "mark"]'
    configuration.write_text(re.sub("(?m)^allow = .*", allowed, configuration.read_text()))
    (tmp_path / "board.toml").write_text(configuration.read_text())
    left_out = await work_through("connect")
    await shell.run(["run", "left-index.toml", "&"])
    await shell.run(["watch"])
    left_out += await work_through("monitor")
    recording = json.loads(await request("start_recording"))["file"]
    await asyncio.sleep(1.2)  # of frames before the mark, which the guides begin after
    await request("mark", "text=lifted")
    await request("stop_recording")
    (tmp_path / "recordings").mkdir()
    for name in ("run", "before", "after", "recordings/run"):
        shutil.copy(recording, tmp_path / f"{name}.mcap")
    await shell.stop()
    left_out += await work_through("replay", "export")
    assert set(left_out) == set(ELSEWHERE)
