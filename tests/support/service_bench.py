"""What the tests of the whole daemon share: a folder with a board, a configuration and the truth."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from emulation import emulated
from observer import Observer

from resonator_daemon.daemon.service.config_store import ConfigStore
from resonator_daemon.daemon.service.daemon import Service
from simulators.emulator import Emulator, EmulatorOptions


class Bench:
    """A folder with a port, a configuration and a truth file, and what runs on them."""

    def __init__(self, folder: Path, broker_url: str) -> None:
        self.folder = folder
        self.port = folder / "board"
        self.truth_path = folder / "truth.jsonl"
        self.broker_url = broker_url

    def scenario(self, text: str) -> str:
        path = self.folder / "scenario.toml"
        path.write_text(text)
        return str(path)

    @asynccontextmanager
    async def emulated(self, plate: str = "quartz16", **options: Any) -> AsyncIterator[Emulator]:
        if "tcp" not in options:
            options |= {"pty": self.port} if plate == "quartz16" else {"tcp": ("127.0.0.1", 0)}
        with emulated(EmulatorOptions(plate, truth=self.truth_path, **options)) as emulator:
            yield emulator

    def service(
        self,
        plate: str = "quartz16",
        link: str | None = None,
        name: str | None = "hand",
        decoding: str = 'method = "fourier"',
        allow: tuple[str, ...] = (),
        measurement: tuple[str, ...] = (),
        mqtt: tuple[str, ...] = (),
        tables: tuple[str, ...] = (),
    ) -> Service:
        config = self.folder / "board.toml"
        lines = [f'plate = "{plate}"', f'link = "{link or f"serial:{self.port}?baud=4000000"}"']
        lines += [f'name = "{name}"'] if name else []
        lines += ["[mqtt]", f'url = "{self.broker_url}"', *mqtt, "[decoding]", decoding]
        lines += ["[measurement]", *measurement] if measurement else []
        lines += ["[commands]", f"allow = {json.dumps(allow)}", *tables]
        config.write_text("\n".join(lines) + "\n")
        return Service(ConfigStore(config, self.folder / "last-good"))

    def recording_config(self, keys: str, directory: Path | None = None) -> Path:
        """Write the configuration of a daemon that records from its start, with these keys of [recording]."""
        config = self.folder / "board.toml"
        config.write_text(
            f'name = "hand"\nplate = "quartz16"\nlink = "serial:{self.port}?baud=4000000"\n'
            f'[mqtt]\nurl = "{self.broker_url}"\n[recording]\nautostart = true\n{keys}\n'
            f'directory = "{directory or self.folder / "recordings"}"\n'
        )
        return config

    @asynccontextmanager
    async def running(self, service: Service) -> AsyncIterator[Service]:
        task = asyncio.create_task(service.run())
        try:
            yield service
        finally:
            service.stop()
            await task

    @asynccontextmanager
    async def measured(self, observer: Observer, service: Service, **board: Any) -> AsyncIterator[Service]:
        """Switch the board on when the service waits for it: a busy computer then misses nothing of what it plays."""
        async with self.running(service):
            await observer.until_last("resonator/hand/state/link", state="waiting")
            async with self.emulated(**board):
                yield service

    def truth(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.truth_path.read_text().splitlines() if line.endswith("}")]

    def windows(self, messages: list[Any]) -> Iterator[tuple[Any, list[dict[str, Any]]]]:
        """Give each message of forces with the truth of the gates, of 1 ms, that it was measured in."""
        truth = self.truth()
        index = {line["board_ticks"]: n for n, line in enumerate(truth)}
        for message in messages:
            last, gates = index.get(int(message["board_ticks"]), 0), round(message["window_s"] * 1000)
            if last + 1 >= gates:
                yield message, truth[last + 1 - gates : last + 1]


def events(observer: Observer) -> list[dict[str, Any]]:
    return observer.payloads("resonator/hand/contacts/event")
