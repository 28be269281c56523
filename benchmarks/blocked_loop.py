"""An event loop that stands still: what the reader keeps meanwhile, and the exact count of what did not fit.

Run it with `python benchmarks/blocked_loop.py [SECONDS]`. Exit code 1 when a frame is in no account.
"""

import asyncio
import logging
import socket
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

from emulated_board import emulated_board

from resonator_daemon.daemon.config_store import ConfigStore
from resonator_daemon.daemon.daemon import Service
from resonator_daemon.session.board_reader import FRAME_QUEUE_BYTES
from resonator_daemon.session.counters import LinkCounters
from resonator_daemon.session.frames import Arrival, ChannelisedFrame, Gap, SingleToneFrame


@dataclass
class Seen:
    """What reached the measurement."""

    frames: int = 0
    missing: int = 0  # indices that were neither a frame nor in a gap
    in_gaps: int = 0
    kept: int = 0  # of the frames that came during the stop
    frame_memory_bytes: int = 0


class _Watched(Service):
    """The daemon, with a count of its frames."""

    def watch(self) -> None:
        self.seen = Seen()
        self._next_index = 0
        self._reached = asyncio.Event()
        self._awaited = 0

    async def reaches(self, frames: int) -> None:
        self._awaited = frames
        self._reached.clear()
        if self.seen.frames < frames:
            await self._reached.wait()

    def _handle(self, arrival: Arrival) -> None:
        if isinstance(arrival, SingleToneFrame | ChannelisedFrame):
            self.seen.frames += 1
            self.seen.frame_memory_bytes = arrival.memory_bytes
            self.seen.missing += arrival.index - self._next_index
            self._next_index = arrival.index + 1
            if self.seen.frames == self._awaited:
                self._reached.set()
        elif isinstance(arrival, Gap):
            self.seen.in_gaps += arrival.loss.total
            self._next_index += arrival.loss.total
        super()._handle(arrival)


async def blocked(plate: str, link: str, folder: Path, seconds: float) -> tuple[LinkCounters, Seen]:
    """Run the daemon and let its event loop stand still once it has frames."""
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    config = folder / "board.toml"
    config.write_text(
        f'name = "bench"\nplate = "{plate}"\nlink = "{link}"\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\n'
        '[decoding]\nmethod = "off"\n'
    )
    service = _Watched(ConfigStore(config, config.parent / "last-good"))
    service.watch()
    task = asyncio.create_task(service.run())
    await service.reaches(100)
    time.sleep(seconds)  # noqa: ASYNC251 - this is what is looked at
    account = service.link_counters
    before = service.seen.frames
    kept = account.frames - account.lost.queue_overflow - before
    await service.reaches(before + kept)
    seen = replace(service.seen, kept=kept)
    service.stop()
    await task
    return account, seen


def main() -> int:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    logging.disable(logging.WARNING)
    wrong = 0
    for plate in ("quartz16", "skin32"):
        with tempfile.TemporaryDirectory() as folder, emulated_board(plate, Path(folder)) as (link, _):
            account, seen = asyncio.run(blocked(plate, link, Path(folder), seconds))
        holds, given_up = FRAME_QUEUE_BYTES // seen.frame_memory_bytes, account.lost.queue_overflow
        otherwise = account.lost.total - given_up
        print(
            f"{plate}: event loop blocked for {seconds:g} s; the ring holds {holds} frames: {seen.kept} kept, "
            f"{given_up} given up and counted, {otherwise} lost otherwise; without frame or gap {seen.missing}"
        )
        wrong += seen.missing + otherwise + (seen.in_gaps != given_up) + (given_up > 0 and seen.kept != holds)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
