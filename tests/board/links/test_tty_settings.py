"""The latency timer of an adapter: shortened where that is permitted, reported where it is not."""

import errno
import logging
import os
from pathlib import Path

import pytest

from resonator_daemon.board.links.tty_settings import shorten_latency_timer

PATH = "/dev/ttyUSB7"


@pytest.fixture
def timer(tmp_path: Path) -> Path:
    """The latency timer of the adapter behind PATH, at 16 ms."""
    timer = tmp_path / "ttyUSB7" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    return timer


def test_a_timer_is_shortened(timer: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    shorten_latency_timer(PATH, timer.parents[2])
    assert timer.read_text() == "1"
    assert not caplog.records


def test_a_timer_that_may_not_be_shortened_is_reported_once_with_the_rule(
    timer: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_path: Path, _text: str) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "write_text", refuse)
    caplog.set_level(logging.INFO)
    shorten_latency_timer(PATH, timer.parents[2])
    shorten_latency_timer(PATH, timer.parents[2])
    (record,) = caplog.records
    assert record.levelno == logging.INFO
    assert f"{PATH} delivers bytes only every 16 ms" in record.getMessage()
    assert 'ATTR{latency_timer}="1"' in record.getMessage()


@pytest.mark.parametrize("text", ["1\n", "0", "none"])
def test_a_timer_that_is_short_or_unreadable_is_left_alone(
    timer: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    timer.write_text(text)
    caplog.set_level(logging.INFO)
    shorten_latency_timer(PATH, timer.parents[2])
    assert timer.read_text() == text
    assert not caplog.records
