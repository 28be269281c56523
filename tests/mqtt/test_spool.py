"""The spool: order, bounds, one holder, and whatever a disk does."""

import os
import shutil
import sqlite3
from pathlib import Path

import pytest

from resonator_daemon.mqtt import spool
from resonator_daemon.mqtt.spool import Progress, Spool, SpoolDamagedError, SpooledEvent, SpoolError

START = Progress((-1, -1), (1, -1))


def events(*numbers: int, run: int = 1, size_bytes: int = 1) -> list[SpooledEvent]:
    return [SpooledEvent((run, number), "a/topic", b"x" * size_bytes) for number in numbers]


def numbers(found: list[SpooledEvent]) -> list[int]:
    return [event.key[1] for event in found]


def test_events_come_back_in_order_whatever_the_order_they_were_written_in(tmp_path: Path) -> None:
    kept = Spool(tmp_path / "missing" / "folder")
    assert kept.open() == (1, 0)
    kept.append(events(5, 6, 7), START, 0)
    kept.append(events(3, 4), START, 0)
    assert numbers(kept.read(START, 10)) == [3, 4, 5, 6, 7]
    assert numbers(kept.read(START, 2)) == [3, 4]
    assert numbers(kept.read(Progress((1, 4), (1, -1)), 2)) == [5, 6]
    assert numbers(kept.read(Progress((-1, -1), (1, 5)), 9)) == [6, 7]
    kept.delete([(1, 3), (1, 5), (1, 99)])
    assert numbers(kept.read(START, 10)) == [4, 6, 7]
    kept.close()


def test_beyond_the_bound_of_events_the_oldest_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool, "EVENTS_MAX", 5)
    kept = Spool(tmp_path)
    kept.open()
    assert kept.append(events(0, 1, 2, 3), START, 0) == 0
    assert kept.append(events(4, 5, 6), START, 9) == 2
    assert numbers(kept.read(START, 10)) == [2, 3, 4, 5, 6]
    after_3 = Progress((1, 3), (1, -1))  # what is in memory, too, stays
    assert kept.append(events(7), after_3, 9) == 1
    assert numbers(kept.read(START, 10)) == [2, 3, 5, 6, 7]
    kept.close()


def test_beyond_the_bound_of_bytes_the_oldest_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spool, "BYTES_MAX", 100)
    kept = Spool(tmp_path)
    kept.open()
    kept.append(events(0, 1, 2, size_bytes=30), START, 0)
    assert kept.append(events(3, size_bytes=60), START, 9) == 2
    assert numbers(kept.read(START, 10)) == [2, 3]
    kept.delete([(1, 2)])
    assert kept.append(events(4, size_bytes=40), START, 9) == 0
    kept.close()


@pytest.mark.parametrize("damage", ["other content", "overwritten pages", "another format"])
def test_a_damaged_file_is_set_aside(tmp_path: Path, damage: str) -> None:
    kept = Spool(tmp_path)
    kept.open()
    kept.append(events(*range(200), size_bytes=500), START, 0)
    kept.close()
    path = tmp_path / spool.FILE
    if damage == "other content":
        path.write_bytes(b"this is no database" * 500)
    elif damage == "overwritten pages":
        content = bytearray(path.read_bytes())
        content[4096:40960] = os.urandom(36864)
        path.write_bytes(content)
    else:
        with sqlite3.connect(path) as other:
            other.execute("PRAGMA user_version=77")
        other.close()
    kept = Spool(tmp_path)
    with pytest.raises(SpoolDamagedError, match=r"set aside as events\.damaged"):
        kept.open()
    assert (tmp_path / "events.damaged").exists()
    assert kept.open() == (1, 0)
    kept.append(events(1), START, 0)
    kept.close()


@pytest.mark.parametrize("lost", ["directory", "database alone", "replaced"])
def test_a_file_that_was_removed_is_made_again_with_all_that_waits(tmp_path: Path, lost: str) -> None:
    directory = tmp_path / "kept" / "spool"
    kept = Spool(directory)
    kept.open()
    kept.append(events(0, 1, 2), START, 0)
    kept.delete([(1, 1)])
    assert not kept.make_again()
    if lost == "directory":
        shutil.rmtree(tmp_path / "kept")
    else:
        (directory / spool.FILE).unlink()
    if lost == "replaced":
        other = Spool(directory)
        other.open()
        other.append(events(0, 7), START, 0)  # as a copy put back has the same ones
        other.close()
    assert kept.make_again()
    assert not kept.make_again()
    kept.append(events(3), START, 0)
    kept.close()
    expected = [0, 2, 3, 7] if lost == "replaced" else [0, 2, 3]
    kept = Spool(directory)
    assert kept.open() == (2, len(expected))
    assert numbers(kept.read(START, 10)) == expected
    kept.close()


def test_what_cannot_be_made_again_can_still_be_read_until_it_can(tmp_path: Path) -> None:
    directory = tmp_path / "spool"
    kept = Spool(directory)
    kept.open()
    kept.append(events(0, 1, 2), START, 0)
    shutil.rmtree(directory)
    directory.write_text("in the way")
    for _ in range(2):
        with pytest.raises(SpoolError, match=r"was removed or replaced, and .*: File exists"):
            kept.make_again()
    assert numbers(kept.read(START, 10)) == [0, 1, 2]
    kept.delete([(1, 0)])
    directory.unlink()
    assert kept.make_again()
    kept.close()
    kept = Spool(directory)
    assert kept.open() == (2, 2)
    kept.close()


def test_a_removed_file_does_not_take_the_place_of_one_that_another_process_holds(tmp_path: Path) -> None:
    kept, other = Spool(tmp_path), Spool(tmp_path)
    kept.open()
    kept.append(events(0), START, 0)
    (tmp_path / spool.FILE).unlink()
    other.open()
    with pytest.raises(SpoolError, match="another process holds"):
        kept.make_again()
    assert numbers(kept.read(START, 10)) == [0]
    other.close()
    assert kept.make_again()
    kept.close()
