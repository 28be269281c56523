"""Low latency: the flag that is asked for, the timer that stays, and what is said of it."""

import errno
import fcntl
import logging
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from resonator_daemon.links.tty_settings import set_low_latency

TIOCGSERIAL, TIOCSSERIAL = 0x541E, 0x541F
FLAGS_AT, LOW_LATENCY = 16, 0x2000
PATH = "/dev/ttyUSB7"


@pytest.fixture
def timer(tmp_path: Path) -> Path:
    """The latency timer of the adapter behind PATH, at 16 ms."""
    timer = tmp_path / "ttyUSB7" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    return timer


@pytest.fixture
def no_terminal() -> Iterator[int]:
    """A descriptor that knows no request of a serial port."""
    with open(os.devnull) as file:
        yield file.fileno()


def test_the_driver_is_asked_for_low_latency_and_for_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = bytearray(range(72))
    struct.pack_into("@i", settings, FLAGS_AT, 0x10)
    given: list[bytes] = []

    def driver(_descriptor: int, asked: int, data: Any) -> int:
        if asked == TIOCGSERIAL:
            data[:] = settings
        else:
            assert asked == TIOCSSERIAL
            given.append(bytes(data))
        return 0

    monkeypatch.setattr(fcntl, "ioctl", driver)
    set_low_latency(0, PATH)
    struct.pack_into("@i", settings, FLAGS_AT, 0x10 | LOW_LATENCY)
    assert given == [bytes(settings)]


def test_a_timer_that_the_driver_left_is_shortened(timer: Path, caplog: pytest.LogCaptureFixture) -> None:
    master, slave = os.openpty()  # has no such flag
    caplog.set_level(logging.INFO)
    set_low_latency(slave, PATH, timer.parents[2])
    os.close(master)
    os.close(slave)
    assert timer.read_text() == "1"
    assert not caplog.records


def test_a_timer_that_may_not_be_shortened_is_said_once_with_the_rule(
    timer: Path, no_terminal: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_path: Path, _text: str) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "write_text", refuse)
    caplog.set_level(logging.INFO)
    set_low_latency(no_terminal, PATH, timer.parents[2])
    set_low_latency(no_terminal, PATH, timer.parents[2])
    (record,) = caplog.records
    assert record.levelno == logging.INFO
    assert f"{PATH} hands bytes on only every 16 ms" in record.getMessage()
    assert 'ATTR{latency_timer}="1"' in record.getMessage()


@pytest.mark.parametrize("text", ["1\n", "0", "none"])
def test_a_timer_that_is_short_or_unreadable_is_left_alone(
    timer: Path, no_terminal: int, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    timer.write_text(text)
    caplog.set_level(logging.INFO)
    set_low_latency(no_terminal, PATH, timer.parents[2])
    assert timer.read_text() == text
    assert not caplog.records
