"""README: its commands work in the order in which they stand, and its lines and words stay within bounds."""

import asyncio
import os
import re
import shlex
import sys
from asyncio.subprocess import Process
from pathlib import Path

from brokers import Mosquitto
from decoder_bench import until

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PROGRAM = str(Path(sys.executable).parent / "resonatord")
LINES_MAX, WORDS_MAX = 120, 900


def commands(section: str, port: Path) -> list[list[str]]:
    """Return the commands of a section, without their comments, for another port than the example's."""
    (text,) = re.findall(rf"^## {section}\n((?:(?!^## ).*\n?)*)", README, re.MULTILINE)
    lines = [line.strip().replace("/tmp/board", str(port)) for line in text.splitlines() if line.startswith("    ")]
    return [shlex.split(line, comments=True) for line in lines]


def test_lines_and_words_are_few() -> None:
    assert [line for line in README.splitlines() if len(line) > LINES_MAX] == []
    assert len(README.split()) <= WORDS_MAX


async def test_a_board_is_connected_by_its_commands(tmp_path: Path, mosquitto: Mosquitto) -> None:
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(tmp_path)}
    running, done = [], []

    async def start(*words: str) -> Process:
        return await asyncio.create_subprocess_exec(
            PROGRAM, *words, cwd=tmp_path, env=environment, stdout=asyncio.subprocess.PIPE
        )

    try:
        for program, verb, *words in commands("Connect a board", tmp_path / "board"):
            assert program == ".venv/bin/resonatord"
            done.append(verb)
            if verb in ("emulate", "run", "watch"):
                url = ("--url", mosquitto.url) if verb == "watch" else ()
                running.append(await start(verb, *(word for word in words if word != "&"), *url))
                if verb == "emulate":
                    await until((tmp_path / "board").exists)
                elif verb == "watch":
                    await has_line(running[-1], b"left-index: daemon online   link online   sensor online")
                continue
            process = await start(verb, *words[: words.index(">")] if ">" in words else words)
            output = (await process.communicate())[0].decode()
            assert process.returncode == 0, (verb, output)
            if ">" in words:
                text = re.sub(r'(?m)^link = "[^"]*"', f'link = "serial:{tmp_path}/board?baud=4000000"', output)
                (tmp_path / words[-1]).write_text(text.replace("mqtt://127.0.0.1:1883", mosquitto.url))
    finally:
        for process in reversed(running):
            process.terminate()
            await process.communicate()
    assert done == ["emulate", "ports", "identify", "config", "check", "run", "watch", "status", "doctor"]


async def has_line(process: Process, begin: bytes) -> None:
    """Wait for a line of the process's output that begins so."""
    assert process.stdout is not None
    async with asyncio.timeout(30):
        while not (await process.stdout.readline()).startswith(begin):
            assert process.returncode is None
