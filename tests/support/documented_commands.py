"""Commands of documentation pages, run as a user would run them, with a board and a broker of the test's own."""

import asyncio
import re
import shlex
import sys
from asyncio.subprocess import Process
from collections.abc import Iterable
from pathlib import Path

from observer import until

PROGRAM = str(Path(sys.executable).parent / "resonatord")
ONLINE = "left-index: daemon online   link online   sensor online"
BOARD = ["emulate", "--plate", "quartz16", "--pty", "/tmp/board", "&"]


def commands(text: str) -> list[list[str]]:
    """Return the words after `resonatord` of each command in a text, without comments."""
    lines = re.findall(r"^ *(?:\.venv/bin/)?resonatord ([a-z][^|\n]*)", text, re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines if "(for" not in line]


class Shell:
    """Runs commands in a folder, with a broker and a place for the port of their own."""

    def __init__(self, folder: Path, broker: str) -> None:
        self._folder = folder
        self._broker = broker
        self._running: list[Process] = []

    async def run_all(self, page: str, elsewhere: Iterable[str]) -> list[str]:
        """Run all commands of a page in their order but those with a part of `elsewhere`; return those parts."""
        found = []
        for words in commands(page):
            parts = [part for part in elsewhere if part in " ".join(words)]
            found += parts
            if not parts:
                await self.run(words)
        return found

    async def run(self, words: list[str]) -> str:
        """Run one command and return its output; of one that goes on until it is stopped, wait until it is ready."""
        words = [word.replace("/tmp/board", f"{self._folder}/board") for word in self._expanded(words)]
        verb = words[0]
        if verb == "replay" and {"--url", "--to"}.isdisjoint(words):
            words += ["--url", self._broker]
        if verb in ("emulate", "run", "watch"):
            url = ("--url", self._broker) if verb == "watch" else ()
            process = await self.start(PROGRAM, *(word for word in words if word != "&"), *url)
            if verb == "emulate":
                await until((self._folder / "board").exists)
            elif verb == "watch":
                await has_line(process, ONLINE)
            return ""
        process = await self.start(PROGRAM, *(words[: words.index(">")] if ">" in words else words))
        output = (await process.communicate())[0].decode()
        assert process.returncode == 0 or "first: computer_busy" in " ".join(output.split()), (verb, output)
        if ">" in words:
            (self._folder / words[-1]).write_text(output.replace("mqtt://127.0.0.1:1883", self._broker))
        return output

    def _expanded(self, words: list[str]) -> list[str]:
        """Return words with patterns of file names replaced by the files that match, as a shell does."""
        found = ((word, sorted(self._folder.glob(word)) if "*" in word else []) for word in words)
        return [str(name) for word, files in found for name in files or (word,)]

    async def start(self, *words: str) -> Process:
        process = await asyncio.create_subprocess_exec(*words, cwd=self._folder, stdout=asyncio.subprocess.PIPE)
        self._running.append(process)
        return process

    async def stop(self) -> None:
        for process in reversed(self._running):
            if process.returncode is None:
                process.terminate()
                await process.communicate()


async def has_line(process: Process, begin: str) -> None:
    """Wait for a line of the process's output that begins so."""
    assert process.stdout is not None
    async with asyncio.timeout(30):
        while not (await process.stdout.readline()).decode().startswith(begin):
            assert process.returncode is None
