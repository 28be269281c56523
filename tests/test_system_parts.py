"""The parts of a whole system: what a killed one would leave behind is gone before it is."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from system_parts import Part


class Stubborn:
    """A process that ends by SIGKILL alone, and notes whether the name was still there when each signal came."""

    def __init__(self, name: Path) -> None:
        self._name = name
        self.seen: list[tuple[signal.Signals, bool]] = []

    def send_signal(self, number: signal.Signals) -> None:
        self.seen.append((number, self._name.is_symlink()))

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        if self.seen[-1][0] is not signal.SIGKILL:
            raise subprocess.TimeoutExpired("stubborn", timeout or 0.0)
        return -signal.SIGKILL


@pytest.fixture
def name(tmp_path: Path) -> Path:
    """Give the name of a terminal as an emulator makes it."""
    path = tmp_path / "port"
    path.symlink_to("/dev/pts/7")
    return path


def part(name: Path, process: Stubborn | None = None) -> Part:
    made = Part("board", (sys.executable, "-c", ""), name.with_name("log"), {}, leftover=name)
    made.process = process  # type: ignore[assignment]
    return made


def test_the_name_of_a_board_is_gone_before_the_board_is_killed(name: Path) -> None:
    board = Stubborn(name)
    assert part(name, board).end(signal.SIGKILL)
    assert board.seen == [(signal.SIGKILL, False)]


def test_a_board_that_does_not_end_by_itself_keeps_its_name_until_it_is_killed(name: Path) -> None:
    board = Stubborn(name)
    assert not part(name, board).end(signal.SIGINT)
    assert board.seen == [(signal.SIGINT, True), (signal.SIGKILL, False)]


def test_what_one_that_died_has_left_is_gone_at_the_next_start(name: Path) -> None:
    board = part(name)
    board.start()
    assert not name.is_symlink()
    assert board.end(signal.SIGTERM)
