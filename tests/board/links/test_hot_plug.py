"""Waiting for a port: what ends the wait at once, what does not, and that nothing between two waits is missed."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from resonator_daemon.board.links.hot_plug import PortWatch

AMPLE_S = 20.0


def came(path: Path, happens: Callable[[], object]) -> bool:
    """Whether a wait that would be long is ended by what happens before it."""
    watch = PortWatch(str(path))
    happens()
    return watch.wait(0.0)


def test_a_port_that_appears_ends_the_wait(tmp_path: Path) -> None:
    port = tmp_path / "ttyACM0"
    watch = PortWatch(str(port))
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


def test_permissions_that_come_late_and_another_device_under_the_name_end_it(tmp_path: Path) -> None:
    port, other = tmp_path / "ttyACM0", tmp_path / "other"
    port.touch(0)
    other.touch()
    assert came(port, lambda: port.chmod(0o660))
    assert came(port, lambda: other.replace(port))


def test_the_same_kind_of_port_with_another_number_ends_it_and_other_files_do_not(tmp_path: Path) -> None:
    port = tmp_path / "ttyACM[0"
    assert came(port, (tmp_path / "ttyACM[1").touch)
    for other in ("ttyUSB0", "ttyACM[", "ttyACM[1x"):
        assert not came(port, (tmp_path / other).touch)
    assert not came(tmp_path / "3", (tmp_path / "4").touch)
    assert not came(tmp_path / "board", (tmp_path / "board1").touch)


def test_directories_that_come_one_by_one_are_followed_and_followed_again_when_they_went(tmp_path: Path) -> None:
    port = tmp_path / "serial" / "by-id" / "board"
    watch = PortWatch(str(port))
    for _ in range(2):
        port.parent.mkdir(parents=True)
        assert not watch.wait(0.0)
        port.touch()
        assert watch.wait(0.0)
        port.unlink()
        port.parent.rmdir()
        assert not watch.wait(0.0)


def test_what_a_dangling_link_points_to_ends_it_when_it_appears(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    (tmp_path / "by-id").mkdir()
    link = tmp_path / "by-id" / "board"
    link.symlink_to("../dev/ttyACM0")
    assert came(link, (tmp_path / "dev" / "ttyACM1").touch)
    assert came(link, (tmp_path / "dev" / "ttyACM0").touch)
    assert came(link, lambda: (tmp_path / "dev" / "ttyACM0").chmod(0o600))


def test_any_device_on_any_bus_ends_the_wait_for_usb_and_one_that_goes_does_not(tmp_path: Path) -> None:
    buses = tmp_path / "bus" / "usb"
    watch = PortWatch(str(buses))  # there is no USB at all
    for device in (buses / "001" / "007", buses / "002" / "001"):
        device.parent.mkdir(parents=True)
        device.touch()
        assert watch.wait(0.0)
        device.chmod(0o600)
        assert watch.wait(0.0)
    device.unlink()
    assert not watch.wait(0.0)


@pytest.mark.parametrize("path", [None, "/none/ttyACM0", "/dev/bus/usb"])
def test_time_and_waking_end_it_without_a_port(path: str | None) -> None:
    watch = PortWatch(path)
    assert not watch.wait(0.01)
    waker = threading.Timer(0.02, watch.wake)
    waker.start()
    assert not watch.wait(AMPLE_S)
    waker.join()
    watch.wake()
    watch.wake()
    assert not watch.wait(AMPLE_S)  # what woke nobody wakes the next, once
