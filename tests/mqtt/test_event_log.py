"""Events that wait and those of the last days: across runs, within bounds, and whatever a disk does."""

import json
import logging
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from brokers import Mosquitto
from mqtt_helpers import delivered, happen, outage, publishing, received_events, scripted_broker, until
from observer import observe
from small_disk import small_disk

from resonator_daemon.mqtt import event_file, event_log
from resonator_daemon.mqtt.event_file import FILE, EventFile, EventFileDamagedError, EventFileError, Span
from resonator_daemon.mqtt.event_log import IN_MEMORY_MAX, EventPage, UnknownRunError

NOBODY = "mqtt://127.0.0.1:9"
LARGE = 2**30
EVERY = Span(0, 2**60, -1)
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


@pytest.fixture
async def generous(tmp_path: Path) -> AsyncIterator[Mosquitto]:
    """A broker that drops nothing of what a subscriber has not taken yet; by default it does so from 1000 on."""
    async with Mosquitto(tmp_path, "allow_anonymous true", "max_queued_messages 0") as broker:
        yield broker


def seqs(page: EventPage) -> list[int]:
    return [json.loads(payload)["seq"] for payload in page.payloads]


def on_disk(directory: Path, run: str = "") -> tuple[set[int], int, bool]:
    """Return numbers of events, how many of them wait, and whether a run is known; the file is held: of a copy."""
    copy = directory.parent / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    copy.mkdir()
    found = EventFile(copy, "")
    try:
        for path in directory.glob(f"{FILE}*"):
            (copy / path.name).write_bytes(path.read_bytes())
        events = {event.seq for event in found.read(EVERY, 100_000)}
        return events, found.open()[1], found.page(run, -1, None, LARGE) is not None
    except (EventFileError, FileNotFoundError):  # it was being written to, or its journal was removed
        return set(), 0, False
    finally:
        found.close()


async def test_what_a_run_leaves_is_sent_first_by_the_next(mosquitto: Mosquitto, tmp_path: Path) -> None:
    directory = tmp_path / "missing" / "folder"
    async with publishing(NOBODY, spool_directory=directory) as left:
        await happen(left, range(100))
    assert (left.account.waiting, left.account.spooled) == (100, 100)
    async with observe(mosquitto.url) as observer, publishing(mosquitto.url, spool_directory=directory) as left:
        await happen(left, range(100, 105))
        events = await received_events(observer, 104)
        await until(lambda: left.account.waiting == 0)
        assert left.account.recovered == 100
        assert left.account.enqueued == 105
    assert [event["seq"] for event in events] == list(range(105))
    assert all(event["replayed"] for event in events[:100])
    async with publishing(mosquitto.url, spool_directory=directory) as left:
        await until(lambda: left.connected)
    assert left.account.recovered == 0
    assert on_disk(directory)[0] == set()  # without a run, delivered events are not stored
    async with publishing(NOBODY, spool_directory=directory) as left:
        await happen(left, range(3))
    assert on_disk(directory)[:2] == ({0, 1, 2}, 3)


async def test_events_that_are_not_acknowledged_wait_also_where_later_ones_are(tmp_path: Path) -> None:
    async with scripted_broker() as (url, script), publishing(url, spool_directory=tmp_path / "kept") as left:
        script.answer = lambda number: 0 if number == 4 else None
        await until(lambda: left.connected)
        await happen(left, range(4))
        await until(lambda: left.account.acknowledged == 1)
        await happen(left, range(4, 5))
        await until(lambda: on_disk(tmp_path / "kept")[:2] == (set(range(5)), 5))
        script.hang_up()


@pytest.mark.parametrize("bound", ["WAITING_MAX", "WAITING_BYTES_MAX"])
async def test_beyond_the_bounds_the_oldest_that_wait_are_dropped(
    mosquitto: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str
) -> None:
    """But for those that memory has, to be sent next, as long as the run lasts."""
    monkeypatch.setattr(event_log, "IN_MEMORY_MAX", 2)
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="a") as left:
        await happen(left, range(100, 101))
        size_bytes = len((await left.stored_events(None, -1, LARGE)).payloads[0])
        monkeypatch.setattr(event_file, bound, 200 if bound == "WAITING_MAX" else 200 * size_bytes)
        for number in range(101, 401):
            await happen(left, range(number, number + 1))
            if number % 10 == 0:
                await until(lambda: left.account.spooled == left.account.waiting)
        dropped = left.account.dropped["spool_full"]
    assert 0 < dropped <= 101
    async with observe(mosquitto.url) as observer, publishing(mosquitto.url, spool_directory=tmp_path) as left:
        events = await received_events(observer, 400)
    assert dropped + left.account.dropped["spool_full"] == 101
    assert [event["seq"] for event in events] == list(range(201, 401))


@pytest.mark.parametrize("damage", ["other content", "overwritten pages", "another format"])
async def test_a_damaged_file_is_set_aside(tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str) -> None:
    async with publishing(NOBODY, spool_directory=tmp_path) as left:
        await happen(left, range(200))
    path = tmp_path / FILE
    if damage == "other content":
        path.write_bytes(b"this is no database" * 500)
    elif damage == "overwritten pages":
        content = bytearray(path.read_bytes())
        content[4096:40960] = os.urandom(36864)
        path.write_bytes(content)
    else:
        with sqlite3.connect(path) as other:
            other.execute("PRAGMA user_version=1")
        other.close()
    async with publishing(NOBODY, spool_directory=tmp_path) as left:
        await happen(left, range(3))
    assert "set aside as events.damaged" in caplog.text
    assert (tmp_path / "events.damaged").exists()
    assert (left.account.recovered, left.account.spooled, left.counts.missed) == (0, 3, 1)  # the farewell


async def test_a_file_that_is_damaged_while_in_use_costs_what_was_on_disk_alone(
    generous: Mosquitto, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    await generous.kill()
    async with publishing(generous.url, spool_directory=tmp_path, boot_id="a") as left:
        await happen(left, range(2000))
        await until(lambda: left.account.spooled == 2000)
        read = EventFile.read

        def damaged(file: EventFile, *arguments: Any) -> Any:
            monkeypatch.setattr(EventFile, "read", read)
            file.close()
            file.path.write_bytes(b"no database" * 1000)
            return read(file, *arguments)

        monkeypatch.setattr(EventFile, "read", damaged)
        await generous.start()
        await delivered(generous.url, left, 1999)
        account = left.account
        assert account.dropped["spool_failed"] == 2000 - account.acknowledged
        assert 0 < account.dropped["spool_failed"] <= 2000 - IN_MEMORY_MAX
        assert "set aside as events.damaged" in caplog.text
        stored = await left.stored_events(None, -1, LARGE)
        assert (seqs(stored)[-IN_MEMORY_MAX:], stored.complete) == (list(range(2000 - IN_MEMORY_MAX, 2000)), False)


async def test_what_a_damaged_file_had_is_counted_as_lost_where_no_new_file_can_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with publishing(NOBODY, spool_directory=tmp_path) as left:
        await happen(left, range(100))
        await until(lambda: left.account.spooled == 100)
        errors = iter([EventFileDamagedError("damaged")])

        def write(*_: object) -> int:
            raise next(errors, EventFileError("no room"))

        monkeypatch.setattr(EventFile, "write", write)
        await happen(left, range(100, 101))
        await until(lambda: left.account.spooled == 0)
    assert (left.account.dropped["spool_failed"], left.account.waiting) == (101, 0)


async def test_delivered_events_are_not_read_again_with_those_on_disk(generous: Mosquitto, tmp_path: Path) -> None:
    async with publishing(generous.url, spool_directory=tmp_path / "kept", boot_id="a") as left:
        async with observe(generous.url) as observer:
            await happen(left, range(500))
            await received_events(observer, 499)
            await until(lambda: left.account.waiting == 0)
        await outage(generous, left, range(500, 2500))
        await until(lambda: on_disk(tmp_path / "kept")[1] == 2000)  # what another run would send
        await generous.start()
        events = await delivered(generous.url, left, 2499)
    assert [event["seq"] for event in events] == list(range(500, 2500))
    assert left.account.dropped == {}


@pytest.mark.parametrize("connected", [False, True])
async def test_a_full_disk_costs_the_oldest_events_beyond_memory_and_no_exception(
    generous: Mosquitto,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    connected: bool,
) -> None:
    """Without a broker, of those that wait; with one, of those that clients may ask for."""
    monkeypatch.setattr(event_log, "RETRY_S", 0.05)
    caplog.set_level(logging.INFO)
    with small_disk(tmp_path, 16 * 2**20) as (disk, fill, free):
        if not connected:
            await generous.kill()
        async with publishing(generous.url, spool_directory=disk, boot_id="a") as left:
            await until(lambda: left.connected is connected)
            await happen(left, range(100))
            await until(lambda: on_disk(disk)[:2] == (set(range(100)), 0 if connected else 100))
            fill()
            await happen(left, range(100, 200))
            await until(lambda: "events cannot be kept on disk" in caplog.text)
            page = await left.stored_events(None, 50, LARGE)
            assert (seqs(page), *page[1:]) == (list(range(51, 200)), True, 0, 199, None)
            for start in range(200, 4000, 200):
                await happen(left, range(start, start + 200))
                await until(lambda: left.account.waiting == 0 or not connected)
            account, held = left.account, list(range(4000 - IN_MEMORY_MAX, 4000))
            assert account.dropped == ({} if connected else {"spool_failed": account.enqueued - account.waiting})
            assert account.waiting - account.spooled == (0 if connected else IN_MEMORY_MAX)
            page = await left.stored_events(None, 50, LARGE)
            assert seqs(page)[-IN_MEMORY_MAX:] == held
            assert (page.complete, page.oldest_seq, page.newest_seq) == (False, 0, 3999)
            assert (await left.stored_events(None, held[0] - 1, LARGE)).complete
            free()
            await until(lambda: "can be kept on disk again" in caplog.text)
            assert caplog.text.count("events cannot be kept on disk") == 1
            if not connected:
                await generous.start()
                await delivered(generous.url, left, 3999)
            assert left.account.acknowledged == 4000 - left.account.dropped.get("spool_failed", 0)
        async with publishing(NOBODY, spool_directory=disk, boot_id="b") as left:
            assert seqs(await left.stored_events("a", held[0] - 1, LARGE)) == held
            assert left.account.recovered == 0


async def test_a_file_that_another_process_holds_is_left_alone(
    mosquitto: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(event_log, "RETRY_S", 0.05)
    here = tmp_path / "kept"
    async with observe(mosquitto.url) as observer:
        async with publishing(NOBODY, spool_directory=here, boot_id="first") as first:
            await happen(first, range(20))
            await until(lambda: first.account.spooled == 20)
            second_run = publishing(mosquitto.url, spool_directory=here, boot_id="second")
            second = await second_run.__aenter__()
            await until(lambda: second.connected and "another process holds" in caplog.text)
            await happen(second, range(20, 25))
            await until(lambda: second.account.waiting == 0)
            assert second.account.recovered == 0
            events = await received_events(observer, 24)
            assert [event["seq"] for event in events] == list(range(20, 25))
            assert seqs(await second.stored_events(None, -1, LARGE)) == list(range(20, 25))
            with pytest.raises(EventFileError, match="another process holds"):
                await second.stored_events("first", -1, LARGE)
        assert (first.account.spooled, caplog.text.count("another process holds")) == (20, 1)
        await until(lambda: second.account.recovered == 20)  # as soon as it is free
        await received_events(observer, 19)
        await happen(second, range(25, 26))
        await received_events(observer, 25)
        await second_run.__aexit__(None, None, None)
    async with publishing(NOBODY, spool_directory=here, boot_id="third") as left:
        assert seqs(await left.stored_events("first", -1, LARGE)) == list(range(20))
        assert seqs(await left.stored_events("second", -1, LARGE)) == list(range(20, 26))
        assert left.account.recovered == 0


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


async def test_a_run_that_was_killed_is_still_there(mosquitto: Mosquitto, tmp_path: Path) -> None:
    directory = tmp_path / "kept"
    here = Path(__file__).parent
    paths = {"PYTHONPATH": f"{here}:{here.parent / 'support'}"}
    async with observe(mosquitto.url):  # else late events wait for a subscriber
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, mosquitto.url, str(directory)], stdout=subprocess.PIPE, env=paths
        )
        assert writer.stdout.readline() == b"acknowledged\n"
        await until(lambda: on_disk(directory) == (set(range(20)), 0, False))
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
    async with publishing(NOBODY, spool_directory=directory, boot_id="without events") as left:
        await until(lambda: on_disk(directory, "without events")[2])
    async with publishing(NOBODY, spool_directory=directory, boot_id="present") as left:
        await happen(left, range(3))
        page = await left.stored_events("killed", 16, LARGE)
        assert (seqs(page), *page[1:]) == ([17, 18, 19], True, 0, 19, "without events")
        assert await left.stored_events("without events", -1, LARGE) == ((), True, None, None, "present")
        assert seqs(await left.stored_events("present", -1, LARGE)) == [0, 1, 2]
        with pytest.raises(UnknownRunError):
            await left.stored_events("never", -1, LARGE)
    assert left.account.recovered == 0


async def test_beyond_the_bound_the_oldest_events_of_any_run_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(event_file, "STORED_MAX", 20)
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
        assert left.account.recovered == 57


@pytest.mark.parametrize("bound", ["STORED_MAX", "STORED_NS_MAX"])
async def test_what_is_delivered_is_deleted_beyond_the_bounds(
    mosquitto: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str
) -> None:
    directory = tmp_path / "kept"
    async with observe(mosquitto.url) as observer:
        async with publishing(mosquitto.url, spool_directory=directory, boot_id="first") as left:
            await happen(left, range(15))
            await until(lambda: on_disk(directory)[:2] == (set(range(15)), 0))
        monkeypatch.setattr(event_file, bound, 1 if bound == "STORED_MAX" else 0)
        async with publishing(mosquitto.url, spool_directory=directory, boot_id="second") as left:
            if bound == "STORED_NS_MAX":
                assert await left.stored_events("first", -1, LARGE) == ((), False, None, 14, "second")
            await happen(left, range(20, 22))
            await received_events(observer, 21)
            await until(lambda: on_disk(directory)[0] <= {20, 21})


async def test_runs_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_file, "RUNS_MAX", 2)
    for boot_id in ("first", "second", "third"):
        async with publishing(NOBODY, spool_directory=tmp_path, boot_id=boot_id) as left:
            await happen(left, range(1))
    async with publishing(NOBODY, spool_directory=tmp_path, boot_id="second") as left:
        assert seqs(await left.stored_events("third", -1, LARGE)) == [0]
        with pytest.raises(UnknownRunError):
            await left.stored_events("first", -1, LARGE)


async def test_a_publisher_without_a_run_has_no_stored_events(tmp_path: Path) -> None:
    async with publishing(NOBODY, spool_directory=tmp_path) as left:
        with pytest.raises(ValueError, match="boot_id"):
            await left.stored_events(None, -1, LARGE)
