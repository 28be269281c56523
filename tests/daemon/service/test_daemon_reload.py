"""A running daemon whose configuration file changes, and one that finds its file broken."""

import asyncio
import contextlib
import json
import logging
import os
import signal
import sys
from pathlib import Path

import pytest
from brokers import Mosquitto
from observer import DEADLINE_S, observe
from service_bench import Bench

from resonator_daemon.board.recording.reader import open_recording
from resonator_daemon.daemon.service.config_store import ConfigStore
from resonator_daemon.daemon.service.daemon import Service

RESONATORD = Path(sys.executable).with_name("resonatord")


async def test_windows_and_commands_are_applied_and_a_bad_file_is_reported(bench: Bench, mosquitto: Mosquitto) -> None:
    async with observe(mosquitto.url) as observer, bench.emulated():
        service = bench.service()
        async with bench.running(service):
            await observer.until_last("resonator/hand/info", step_s=0.005)
            path = bench.folder / "board.toml"
            good = path.read_text().replace("allow = []", 'allow = ["tare"]')
            path.write_text(good + "[measurement]\nwindow_ms = 20\nstep_ms = 10\n")
            service.reload()
            await observer.until_last("resonator/hand/info", step_s=0.01)
            await observer.until_last("resonator/hand/forces", window_s=0.02)
            await observer.until(lambda: "tare" in observer.payloads("resonator/hand/info")[-1]["commands"])
            path.write_text("name = \n")
            service.reload()
            await observer.until_last("resonator/hand/state/daemon", state="online", reason_code="bad_configuration")
            path.write_text(good)
            service.reload()
            await observer.until_last("resonator/hand/state/daemon", reason_code="measuring")
            await observer.until_last("resonator/hand/info", step_s=0.005)


async def test_continuous_recording_begins_with_the_first_byte_and_is_switched_by_a_reload(
    bench: Bench, tmp_path: Path, mosquitto: Mosquitto
) -> None:
    async with observe(mosquitto.url) as observer, bench.emulated():
        bench.service()
        path = bench.folder / "board.toml"
        bare = path.read_text()
        path.write_text(f'{bare}[recording]\ndirectory = "{tmp_path}/runs"\nautostart = true\n')
        service = Service(ConfigStore(path, bench.folder / "last-good"))
        async with bench.running(service):
            await observer.until_count("resonator/hand/forces", 20)
            path.write_text(bare)
            service.reload()
            await observer.until(
                lambda: (
                    bool(told := observer.payloads("resonator/hand/health"))
                    and (told[-1]["recording"]["file"], told[-1]["recording"]["files"]) == (None, 1)
                )
            )
        (file,) = (tmp_path / "runs").glob("*.mcap")
    with open_recording(str(file)) as recording:
        kinds = [type(event).__name__ for event in recording.events()]
    assert kinds.index("Opened") < kinds.index("Received")
    assert recording.damage is None


async def test_what_is_reloaded_before_a_board_has_given_its_name_holds_when_it_does(
    bench: Bench, tmp_path: Path, mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    async with observe(mosquitto.url) as observer:
        service = bench.service(name=None)
        path = bench.folder / "board.toml"
        async with bench.running(service):
            path.write_text(f'{path.read_text()}[recording]\ndirectory = "{tmp_path}/runs"\nautostart = true\n')
            service.reload()
            async with asyncio.timeout(DEADLINE_S):
                while "configuration read again" not in caplog.text:  # noqa: ASYNC110 - nothing is published yet
                    await asyncio.sleep(0.005)
            async with bench.emulated():
                await observer.until_last("resonator/EMU-0001/state/link", state="online")
                await observer.until(
                    lambda: (
                        bool(states := observer.payloads("resonator/EMU-0001/health"))
                        and bool(states[-1]["recording"]["file"])
                    )
                )


async def test_a_reload_at_the_end_is_ignored(bench: Bench, mosquitto: Mosquitto) -> None:
    bench.service(link="tcp://127.0.0.1:9")
    async with observe(mosquitto.url) as observer:
        command = (RESONATORD, "run", "--config", bench.folder / "board.toml")
        process = await asyncio.create_subprocess_exec(*command, env=os.environ, stderr=asyncio.subprocess.PIPE)
        await observer.until_last("resonator/hand/state/daemon", state="online", reason_code="no_board")
        process.send_signal(signal.SIGTERM)
        ended = asyncio.create_task(process.communicate())
        while not ended.done():
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGHUP)  # `send_signal` may reap it, and asyncio then calls its code 255
            await asyncio.wait([ended], timeout=0.01)
        _, said = await ended
    assert (process.returncode, b"Traceback" in said) == (0, False)


async def test_sighup_reads_the_file_again_and_sigterm_ends(bench: Bench, mosquitto: Mosquitto) -> None:
    bench.service(link="tcp://127.0.0.1:9")
    path = bench.folder / "board.toml"
    async with observe(mosquitto.url) as observer:
        command = (RESONATORD, "run", "--config", path)
        process = await asyncio.create_subprocess_exec(*command, env=os.environ, stderr=asyncio.subprocess.PIPE)
        await observer.until_last("resonator/hand/state/daemon", state="online", reason_code="no_board")
        path.write_text(path.read_text().replace("tcp://127.0.0.1:9", "tcp://127.0.0.1:10"))
        reload = (RESONATORD, "reload", "hand", "--json")
        pipe = asyncio.subprocess.PIPE
        asked = await asyncio.create_subprocess_exec(*reload, env=os.environ, stdout=pipe)
        printed, _ = await asked.communicate()
        report = json.loads(printed)
        assert (asked.returncode, report["ok"], report["problems"]) == (0, True, [])
        change = {"key": "link", "old": "'tcp://127.0.0.1:9'", "new": "'tcp://127.0.0.1:10'", "applied": False}
        assert report["changes"] == [change]
        await observer.until_last("resonator/hand/state/daemon", state="online", reason_code="restart_needed")
        good = path.read_text()
        path.write_text("name = \n")
        asked = await asyncio.create_subprocess_exec(*reload, env=os.environ, stdout=pipe, stderr=pipe)
        printed, _ = await asked.communicate()
        assert (asked.returncode, len(json.loads(printed)["problems"])) == (1, 1)
        path.write_text(good)
        process.send_signal(signal.SIGTERM)
        _, said = await process.communicate()
    assert process.returncode == 0
    assert b"configuration read again: restart for link" in said
