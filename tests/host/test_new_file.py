"""New files are whole or not there, whoever interrupts the verb that makes them."""

import signal
from pathlib import Path

import pytest

from resonator_daemon.errors import InterruptedCommandError, UserError
from resonator_daemon.host.new_file import NewFile, interruptible


def handlers() -> list[object]:
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_cleaned_up_after_once_and_said(tmp_path: Path, number: signal.Signals) -> None:
    before = handlers()
    cleaned = []

    def make() -> None:
        with interruptible("nothing is kept"):
            new = NewFile(tmp_path / "out")
            try:
                signal.raise_signal(number)
            finally:
                signal.raise_signal(signal.SIGINT)  # by somebody impatient
                signal.raise_signal(number)
                new.discard()
                cleaned.append(True)

    with pytest.raises(InterruptedCommandError, match=r"^interrupted: nothing is kept$") as caught:
        make()
    assert caught.value.exit_code == 1
    assert cleaned == [True]
    assert list(tmp_path.iterdir()) == []
    assert handlers() == before


def test_what_a_process_ignores_it_goes_on_ignoring() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup has it
    try:
        with interruptible("nothing is kept"):
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_file_gets_its_name_once_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "out"
    new = NewFile(path)
    new.file.write(b"12345")
    assert not path.exists()
    with pytest.raises(UserError, match=r"out\.part exists: another process writes it, or was killed"):
        NewFile(path)
    assert new.keep() == 5
    assert [file.name for file in tmp_path.iterdir()] == ["out"]
    assert path.read_bytes() == b"12345"


def test_what_came_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "out"
    new = NewFile(path)
    path.write_text("mine")
    with pytest.raises(UserError, match="exists already, and nothing is overwritten"):
        new.keep()
    new.discard()
    assert [file.read_text() for file in tmp_path.iterdir()] == ["mine"]
