"""Stored events: what a client has missed, from this run and earlier ones, within bounds, and whatever a disk does."""

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mqtt_helpers import happen, publishing, until
from observer import observe
from small_disk import small_disk

from resonator_daemon.mqtt import event_history, event_queue
from resonator_daemon.mqtt.event_history import UNWRITTEN_MAX, HistoryPage, UnknownRunError
from resonator_daemon.mqtt.spool import Spool, SpoolError

NOBODY = "mqtt://127.0.0.1:9"
LARGE = 2**30
WRITER = """
import asyncio, sys
from pathlib import Path
from mqtt_helpers import happen, publishing

async def main():
    async with publishing(sys.argv[1], spool_directory=Path(sys.argv[2]), boot_id="killed") as left:
        for number in range(20):
            await happen(left, range(number, number + 1))
        while (await left.stored_events("killed", -1, 2**30)).newest_seq != 19 or left.account.waiting:
            await asyncio.sleep(0.01)
        print("acknowledged", flush=True)
        await asyncio.sleep(3600)

asyncio.run(main())
"""


def seqs(page: HistoryPage) -> list[int]:
    return [json.loads(payload)["seq"] for payload in page.payloads]


def stored(directory: Path, column: str = "seq FROM history") -> set[Any]:
    """Return the numbers of the events, or another column, in a copy of the file: it is held by one process alone."""
    copy = directory.parent / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    copy.mkdir()
    for path in directory.glob("events.sqlite3*"):
        (copy / path.name).write_bytes(path.read_bytes())
    found = Spool(copy)
    try:
        return set(found.transact(lambda database: [row[0] for row in database.execute(f"SELECT {column}")]))
    except SpoolError:  # it was being written to
        return set()
    finally:
        found.close()


async def test_pages_join_without_a_gap(tmp_path: Path) -> None:
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="a") as left:
        await happen(left, range(100))
        size_bytes = len((await left.stored_events(None, -1, 1)).payloads[0])
        pages = [await left.stored_events(None, -1, 30 * size_bytes + 29)]
        while seqs(pages[-1])[-1] < 99:
            pages.append(await left.stored_events(None, seqs(pages[-1])[-1], 30 * size_bytes + 29))
    assert [number for page in pages for number in seqs(page)] == list(range(100))
    assert all(page[1:] == (True, 0, 99, None) for page in pages)
    assert all(sum(map(len, page.payloads)) <= 30 * size_bytes + 29 for page in pages)
    assert len(pages) == 4


async def test_a_run_that_was_killed_is_still_there(mosquitto: Any, tmp_path: Path) -> None:
    directory = tmp_path / "kept"
    here = Path(__file__).parent
    paths = {"PYTHONPATH": f"{here}:{here.parent / 'support'}"}
    async with observe(mosquitto.url):  # else late events wait for a subscriber
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, mosquitto.url, str(directory)], stdout=subprocess.PIPE, env=paths
        )
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"acknowledged\n"
        await until(lambda: stored(directory) == set(range(20)))
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
    async with publishing(NOBODY, spool_directory=directory, boot_id="without events") as left:
        await until(lambda: stored(directory, "boot FROM runs") == {"killed", "without events"})
    async with publishing(NOBODY, spool_directory=directory, boot_id="present") as left:
        await happen(left, range(3))
        page = await left.stored_events("killed", 16, LARGE)
        assert (seqs(page), *page[1:]) == ([17, 18, 19], True, 0, 19, "without events")
        assert await left.stored_events("without events", -1, LARGE) == ((), True, None, None, "present")
        assert seqs(await left.stored_events("present", -1, LARGE)) == [0, 1, 2]
        with pytest.raises(UnknownRunError):
            await left.stored_events("never", -1, LARGE)


async def test_beyond_the_bound_of_events_the_oldest_go_of_whatever_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_history, "EVENTS_MAX", 20)
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="first") as left:
        await happen(left, range(15))
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="second") as left:
        await happen(left, range(12))
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="third") as left:
        first = await left.stored_events("first", -1, LARGE)
        assert (seqs(first), *first[1:]) == (list(range(7, 15)), False, 7, 14, "second")
        assert (await left.stored_events("first", 6, LARGE)).complete
        assert (await left.stored_events("second", -1, LARGE))[1:] == (True, 0, 11, "third")
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="fourth") as left:
        await happen(left, range(30))
        assert (await left.stored_events(None, -1, LARGE)).newest_seq == 29
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="fifth") as left:
        assert await left.stored_events("first", 3, LARGE) == ((), False, None, 14, "second")
        assert seqs(await left.stored_events("fourth", -1, LARGE)) == list(range(10, 30))


async def test_beyond_the_bound_of_age_they_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="first") as left:
        await happen(left, range(15))
    monkeypatch.setattr(event_history, "AGE_MAX_NS", 0)
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="second") as left:
        assert await left.stored_events("first", -1, LARGE) == ((), False, None, 14, "second")
        await happen(left, range(1))
    assert stored(tmp_path) <= {0}


async def test_runs_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_history, "RUNS_MAX", 2)
    for boot_id in ("first", "second", "third"):
        async with publishing(NOBODY, spool_directory=tmp_path, boot_id=boot_id) as left:
            await happen(left, range(1))
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="second") as left:
        assert seqs(await left.stored_events("third", -1, LARGE)) == [0]
        with pytest.raises(UnknownRunError):
            await left.stored_events("first", -1, LARGE)


async def test_a_full_disk_leaves_the_newest_in_memory(
    mosquitto: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(event_queue, "RETRY_S", 0.05)
    with small_disk(tmp_path, 16 * 2**20) as (disk, fill, free):
        async with publishing(mosquitto.url, spool_directory=disk, boot_id="a") as left:
            await until(lambda: left.connected)
            await happen(left, range(100))
            await until(lambda: left.account.waiting == 0)
            assert seqs(await left.stored_events(None, -1, LARGE)) == list(range(100))
            await until(lambda: stored(disk) == set(range(100)))
            fill()
            await happen(left, range(100, 200))
            await until(lambda: "events cannot be kept on disk" in caplog.text)
            page = await left.stored_events(None, 50, LARGE)
            assert (seqs(page), *page[1:]) == (list(range(51, 200)), True, 0, 199, None)
            for start in range(200, 2000, 200):
                await happen(left, range(start, start + 200))
                await until(lambda: left.account.waiting == 0)
            page = await left.stored_events(None, 50, LARGE)
            held = seqs(page)[-UNWRITTEN_MAX:]
            assert held == list(range(2000 - UNWRITTEN_MAX, 2000))
            assert (page.complete, page.oldest_seq, page.newest_seq) == (False, 0, 1999)
            assert (await left.stored_events(None, held[0] - 1, LARGE)).complete
            free()
            await until(lambda: stored(disk) >= set(held))
            assert (left.account.dropped, left.account.acknowledged) == ({}, 2000)
            assert caplog.text.count("events cannot be kept on disk") == 1
        async with publishing(NOBODY, spool_directory=disk, boot_id="b") as left:
            assert seqs(await left.stored_events("a", held[0] - 1, LARGE)) == held


async def test_a_file_that_was_removed_is_made_again_with_what_is_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_queue, "LOOK_S", 0.01)
    directory = tmp_path / "kept"
    async with publishing(NOBODY, spool_directory=directory, boot_id="first") as left:
        await happen(left, range(5))
    async with publishing(NOBODY, spool_directory=directory, boot_id="second") as left:
        await happen(left, range(5))
        await until(lambda: stored(directory) == set(range(5)) and left.account.spooled == 10)
        shutil.rmtree(directory)
        await until(lambda: stored(directory) == set(range(5)))
        for boot_id, next_boot_id in (("first", "second"), ("second", None)):
            page = await left.stored_events(boot_id, 1, LARGE)
            assert (seqs(page), *page[1:]) == ([2, 3, 4], True, 0, 4, next_boot_id)


async def test_where_another_process_holds_the_file_memory_has_this_run_alone(tmp_path: Path) -> None:
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="first") as first:
        await happen(first, range(3))
        await until(lambda: first.account.spooled == 3)
        async with publishing(NOBODY, spool_directory=tmp_path, boot_id="second") as second:
            await happen(second, range(4))
            assert seqs(await second.stored_events(None, -1, LARGE)) == [0, 1, 2, 3]
            with pytest.raises(SpoolError, match="another process holds"):
                await second.stored_events("first", -1, LARGE)


async def test_a_publisher_without_a_run_stores_nothing(tmp_path: Path) -> None:
    async with publishing(NOBODY, spool_directory=tmp_path) as left:
        await happen(left, range(3))
        await until(lambda: left.account.spooled == 3)
        with pytest.raises(ValueError, match="boot_id"):
            await left.stored_events(None, -1, LARGE)
    assert stored(tmp_path) == set()
