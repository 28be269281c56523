"""A daemon that may open nothing more: it measures on, says so in a few lines, and recovers.

It has no locale, and a time zone far from UTC; neither changes anything.
"""

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import psutil
from brokers import Mosquitto
from observer import Observer, observe
from service_bench import Bench

from resonator_daemon.base.host.files import runtime_directory
from simulators.faults import parse_faults

DEADLINE_S = 60.0
# A recording that failed is tried again every half second: after ten, as it is, the test only waits.
RUN = "; ".join(
    (
        "from resonator_daemon.board.recording import recorder",
        "recorder.TIMES = recorder.TIMES._replace(retry_s=0.5)",
        "from resonator_daemon.commands import main",
        "raise SystemExit(main())",
    )
)
ODD = {"LC_ALL": "C", "TZ": "XYZ-13:45"}


@asynccontextmanager
async def daemon(bench: Bench, log: Path) -> AsyncIterator[psutil.Process]:
    config = bench.recording_config("file_max_minutes = 0.01")
    command = [sys.executable, "-c", RUN, "run", "--config", str(config)]
    with log.open("wb") as stderr:
        process = subprocess.Popen(command, stderr=stderr, env=os.environ | ODD)
    try:
        yield psutil.Process(process.pid)
    finally:
        process.terminate()
        ended = await asyncio.to_thread(process.wait, DEADLINE_S)
    assert ended == 0, log.read_text()


async def health(observer: Observer, frames: int, *, connections: int = 1) -> dict[str, Any]:
    """Wait for a message with at least so many frames, boots and connections."""
    async with asyncio.timeout(DEADLINE_S):
        while True:
            found = observer.payloads("resonator/hand/health")
            if found and found[-1]["frames"] >= frames and found[-1]["connections"] >= connections:
                return dict(found[-1])
            await asyncio.sleep(0.02)


async def status() -> dict[str, Any]:
    async with asyncio.timeout(DEADLINE_S):
        while True:
            try:
                reader, writer = await asyncio.open_unix_connection(runtime_directory("board") / "status.sock")
                try:
                    if answer := await reader.read(-1):
                        return dict(json.loads(answer))
                finally:
                    writer.close()
            except OSError:
                await asyncio.sleep(0.05)  # it listens anew a second after it failed


async def test_without_descriptors_it_measures_on_and_recovers(tmp_path: Path, mosquitto: Mosquitto) -> None:
    folder = tmp_path / "Prüfstand Ω"
    folder.mkdir()
    bench, log = Bench(folder, mosquitto.url), tmp_path / "log"
    faults = parse_faults("unplug_at_s=3,unplug_for_s=0.2")
    async with (
        observe(mosquitto.url, "resonator/hand/+/#") as observer,
        bench.emulated(scenario="still", faults=faults),
        daemon(bench, log) as process,
    ):
        before = await health(observer, 500)
        soft, hard = process.rlimit(psutil.RLIMIT_NOFILE)
        process.rlimit(psutil.RLIMIT_NOFILE, (3, hard))
        asking = asyncio.create_task(status())
        starved = await health(observer, before["frames"] + 1000)  # a file of the recording has ended meanwhile
        assert starved["file_descriptors"] == 3
        assert starved["rss_mb"] > 0
        links = "resonator/hand/state/link"
        await observer.until(lambda: any("Too many open files" in link["reason"] for link in observer.payloads(links)))
        healths = len(observer.payloads("resonator/hand/health"))
        await observer.until_count("resonator/hand/health", healths + 2)
        process.rlimit(psutil.RLIMIT_NOFILE, (soft, hard))
        assert (await asking)["pid"] == process.pid
        again = await health(observer, starved["frames"] + 500, connections=2)
        assert again["file_descriptors"] > 3
        async with asyncio.timeout(DEADLINE_S):
            while (told := await status())["recording"]["failure"] is not None:
                pass  # it is made ten times a second
        assert told["recording"]["files"] > 1
        stamp = Path(told["recording"]["file"]).name.removeprefix("hand-").removesuffix("Z.mcap")
        began = datetime.strptime(f"{stamp}+0000", "%Y%m%dT%H%M%S.%f%z")
        assert abs(began - datetime.now(UTC)) < timedelta(minutes=10)
    lines = log.read_text().splitlines()
    assert sum("Too many open files" in line for line in lines) <= 4, lines
    assert "Traceback" not in log.read_text()
