"""Events that wait on disk: across runs, and with a disk that is full, damaged, held by another or robbed."""

import logging
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from brokers import Mosquitto
from mqtt_helpers import happen, publishing, received_events, until
from observer import observe
from small_disk import small_disk

from resonator_daemon.mqtt import event_queue, spool
from resonator_daemon.mqtt.event_queue import IN_MEMORY_MAX


@pytest.fixture
async def generous(tmp_path: Path) -> AsyncIterator[Mosquitto]:
    """A broker that drops nothing of what a subscriber has not taken yet; by default it does so from 1000 on."""
    broker = Mosquitto(tmp_path, "allow_anonymous true", "max_queued_messages 0")
    await broker.start()
    yield broker
    await broker.kill()


async def test_what_a_run_leaves_is_sent_first_by_the_next(mosquitto, tmp_path: Path) -> None:
    async with publishing("mqtt://127.0.0.1:9", spool_directory=tmp_path) as left:
        await happen(left, range(100))
    assert (left.account.waiting, left.account.spooled) == (100, 100)
    async with observe(mosquitto.url) as observer, publishing(mosquitto.url, spool_directory=tmp_path) as left:
        await happen(left, range(100, 105))
        events = await received_events(observer, 104)
        await until(lambda: left.account.waiting == 0)
        assert left.account.recovered == 100
        assert left.account.enqueued == 105
    assert [event["seq"] for event in events] == list(range(105))
    assert all(event["replayed"] for event in events[:100])
    async with publishing(mosquitto.url, spool_directory=tmp_path) as left:
        await until(lambda: left.connected)
    assert left.account.recovered == 0


async def test_a_full_disk_costs_the_oldest_events_beyond_memory_and_no_exception(
    generous, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(event_queue, "RETRY_S", 0.05)
    caplog.set_level(logging.INFO)
    with small_disk(tmp_path, 16 * 2**20) as (disk, fill, free):
        await generous.kill()
        async with publishing(generous.url, spool_directory=disk) as left:
            await happen(left, range(50))
            await until(lambda: left.account.spooled == 50)
            fill()
            await happen(left, range(50, 3000))
            await until(lambda: "events cannot be kept on disk" in caplog.text)
            await happen(left, range(3000, 4000))
            account = left.account
            assert account.dropped == {"spool_failed": account.enqueued - account.waiting}
            assert account.waiting - account.spooled == IN_MEMORY_MAX
            free()
            await until(lambda: "can be kept on disk again" in caplog.text)
            assert caplog.text.count("events cannot be kept on disk") == 1
            await generous.start()
            async with observe(generous.url) as observer:
                await received_events(observer, 3999)
                await until(lambda: left.account.waiting == 0)
            kept = 4000 - account.dropped["spool_failed"]
            assert left.account.acknowledged == kept


async def test_a_spool_that_another_process_holds_is_left_alone(
    mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(event_queue, "RETRY_S", 0.05)
    async with publishing("mqtt://127.0.0.1:9", spool_directory=tmp_path) as first:
        await happen(first, range(20))
        await until(lambda: first.account.spooled == 20)
        async with observe(mosquitto.url) as observer, publishing(mosquitto.url, spool_directory=tmp_path) as second:
            await until(lambda: second.connected and "another process holds" in caplog.text)
            await happen(second, range(20, 25))
            await until(lambda: second.account.waiting == 0)
            assert second.account.recovered == 0
            events = await received_events(observer, 24)
            assert [event["seq"] for event in events] == list(range(20, 25))
    assert first.account.spooled == 20
    assert caplog.text.count("another process holds") == 1


async def test_a_spool_that_is_damaged_while_in_use_costs_what_was_on_disk_alone(
    generous, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    await generous.kill()
    async with publishing(generous.url, spool_directory=tmp_path) as left:
        await happen(left, range(2000))
        await until(lambda: left.account.spooled == 2000)
        read = spool.Spool.read

        def damaged(kept: spool.Spool, *arguments: Any) -> Any:
            monkeypatch.setattr(spool.Spool, "read", read)
            kept.close()
            kept.path.write_bytes(b"no database" * 1000)
            return read(kept, *arguments)

        monkeypatch.setattr(spool.Spool, "read", damaged)
        await generous.start()
        async with observe(generous.url) as observer:
            await received_events(observer, 1999)
            await until(lambda: left.account.waiting == 0)
        account = left.account
        assert account.dropped["spool_failed"] == 2000 - account.acknowledged
        assert 0 < account.dropped["spool_failed"] <= 2000 - IN_MEMORY_MAX
        assert "set aside as events.damaged" in caplog.text


@pytest.mark.parametrize("noticed_by", ["looking", "writing", "ending"])
async def test_a_spool_that_is_removed_is_made_again_and_said_once(
    mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, noticed_by: str
) -> None:
    monkeypatch.setattr(event_queue, "LOOK_S", 0.01 if noticed_by == "looking" else 3600.0)
    directory, expected = tmp_path / "kept", 15
    async with publishing("mqtt://127.0.0.1:9", spool_directory=directory) as left:
        await happen(left, range(15))
        await until(lambda: left.account.spooled == 15)
        shutil.rmtree(directory)
        if noticed_by == "looking":
            await until(lambda: "made again" in caplog.text)
            assert (directory / spool.FILE).exists()
        elif noticed_by == "writing":
            expected = 18
            await happen(left, range(15, 18))
            await until(lambda: left.account.spooled == 18)
            assert (directory / spool.FILE).exists()
    assert [record.getMessage() for record in caplog.records if "removed" in record.getMessage()] == [
        f"{directory / spool.FILE} was removed or replaced: made again; 15 events wait in it"
    ]
    async with observe(mosquitto.url) as observer, publishing(mosquitto.url, spool_directory=directory) as left:
        events = await received_events(observer, expected - 1)
        assert left.account.recovered == expected
    assert [event["seq"] for event in events] == list(range(expected))
