"""Waiting for a port: what ends the wait at once, what does not, and that nothing between two waits is missed."""

import errno
import os
import struct
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from pathlib import Path
from types import SimpleNamespace

import pytest

from resonator_daemon.board.links import hot_plug as port_watch
from resonator_daemon.board.links import inotify as port_inotify
from resonator_daemon.board.links.hot_plug import PortWatch
from resonator_daemon.board.links.inotify import DirectoryEvents

AMPLE_S = 20.0


def watching(path: Path) -> AbstractContextManager[PortWatch]:
    return closing(PortWatch(str(path)))


def came(path: Path, happens: Callable[[], object]) -> bool:
    """Whether a wait that would be long is ended by what happens before it."""
    with watching(path) as watch:
        happens()
        return watch.wait(0.0)


def test_a_port_that_appears_ends_the_wait(tmp_path: Path) -> None:
    port = tmp_path / "ttyACM0"
    with watching(port) as watch:
        plugger = threading.Timer(0.05, port.touch)
        plugger.start()
        assert watch.wait(AMPLE_S)
        plugger.join()
        assert not watch.wait(0.0)  # told once


def test_a_port_that_stays_as_it_is_or_goes_does_not_end_it(tmp_path: Path) -> None:
    port = tmp_path / "ttyACM0"
    port.touch()
    assert not came(port, port.read_bytes)
    assert not came(port, port.unlink)


def test_permissions_that_come_late_end_it(tmp_path: Path) -> None:
    port = tmp_path / "ttyACM0"
    port.touch(0)
    assert came(port, lambda: port.chmod(0o660))


def test_the_same_kind_of_port_with_another_number_ends_it_and_other_files_do_not(tmp_path: Path) -> None:
    port = tmp_path / "ttyACM0"
    assert came(port, (tmp_path / "ttyACM1").touch)
    assert not came(port, (tmp_path / "ttyUSB0").touch)
    assert not came(port, (tmp_path / "ttyACM").touch)
    assert not came(tmp_path / "3", (tmp_path / "4").touch)


def test_directories_that_come_one_by_one_are_followed_and_followed_again_when_they_went(tmp_path: Path) -> None:
    port = tmp_path / "serial" / "by-id" / "board"
    with watching(port) as watch:
        for _ in range(2):
            for directory in (port.parent.parent, port.parent):
                directory.mkdir()
                assert not watch.wait(0.0)
            port.touch()
            assert watch.wait(0.0)
            port.unlink()
            port.parent.rmdir()
            port.parent.parent.rmdir()
            assert not watch.wait(0.0)


def test_a_directory_that_appears_while_its_parent_is_aimed_at_is_not_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "by-id" / "board"
    watch_directories = DirectoryEvents.watch

    def late(events: DirectoryEvents, directories: set[str]) -> None:
        port.parent.mkdir(exist_ok=True)  # after it was looked for, before its parent is watched
        watch_directories(events, directories)

    monkeypatch.setattr(DirectoryEvents, "watch", late)
    assert came(port, port.touch)


def test_what_a_dangling_link_points_to_ends_it_when_it_appears(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    (tmp_path / "by-id").mkdir()
    link = tmp_path / "by-id" / "board"
    link.symlink_to("../dev/board-port")
    assert came(link, (tmp_path / "dev" / "board-port").touch)
    assert came(link, lambda: (tmp_path / "dev" / "board-port").chmod(0o600))


def test_any_device_on_any_bus_ends_the_wait_for_usb(tmp_path: Path) -> None:
    buses = tmp_path / "bus" / "usb"
    with watching(buses) as watch:
        (buses / "001").mkdir(parents=True)
        assert watch.wait(0.0)  # there was no USB at all
        (buses / "001" / "007").touch()
        assert watch.wait(0.0)
        (buses / "001" / "007").chmod(0o600)
        assert watch.wait(0.0)
        (buses / "002").mkdir()
        assert watch.wait(0.0)
        (buses / "002" / "001").touch()
        assert watch.wait(0.0)
        assert not watch.wait(0.0)


@pytest.mark.parametrize("path", [None, "/none/ttyACM0", "/dev/bus/usb"])
def test_time_and_waking_end_it_without_a_port(path: str | None) -> None:
    with closing(PortWatch(path)) as watch:
        assert not watch.wait(0.01)
        waker = threading.Timer(0.02, watch.wake)
        waker.start()
        assert not watch.wait(AMPLE_S)
        waker.join()
        watch.wake()
        watch.wake()
        assert not watch.wait(AMPLE_S)  # what woke nobody wakes the next, once


def test_a_system_without_inotify_is_waited_on_by_time_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left() -> DirectoryEvents:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(port_watch, "DirectoryEvents", none_left)
    assert not came(tmp_path / "ttyACM0", (tmp_path / "ttyACM0").touch)


def test_events_that_the_system_had_no_room_for_are_taken_for_the_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "ttyACM0"
    queue = [struct.pack("iIII", -1, 0x4000, 0, 0)]  # the kernel's record of an overflow, in place of what it had

    def read(_descriptor: int, _count: int) -> bytes:
        if not queue:
            raise BlockingIOError
        return queue.pop()

    monkeypatch.setattr(port_inotify, "os", SimpleNamespace(**vars(os) | {"read": read}))
    assert came(port, port.touch)
