"""Signals end a command after one clean-up, and are not lost while a module is imported."""

import signal
from importlib import import_module
from pathlib import Path
from threading import Event

import pytest
from observer import until

from resonator_daemon.base.errors import InterruptedCommandError
from resonator_daemon.base.host.files import NewFile
from resonator_daemon.base.host.signals import interruptible, on_signals


def handlers() -> list[object]:
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_causes_one_clean_up_and_one_error(tmp_path: Path, number: signal.Signals) -> None:
    before = handlers()
    cleaned = []

    def make() -> None:
        with interruptible("nothing is kept"):
            new = NewFile(tmp_path / "out")
            try:
                signal.raise_signal(number)
            finally:
                signal.raise_signal(signal.SIGINT)  # a second one during the clean-up
                signal.raise_signal(number)
                new.discard()
                cleaned.append(True)

    with pytest.raises(InterruptedCommandError, match=r"^interrupted: nothing is kept$") as caught:
        make()
    assert caught.value.exit_code == 1
    assert cleaned == [True]
    assert list(tmp_path.iterdir()) == []
    assert handlers() == before


def test_ignored_signals_remain_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup has it
    try:
        with interruptible("nothing is kept"):
            signal.raise_signal(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_while_a_module_loads_comes_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "import signal\ntry:\n    signal.raise_signal(signal.SIGTERM)\nexcept KeyboardInterrupt:\n    pass\n"
    (tmp_path / "loses_interrupts.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)

    def load() -> None:
        with interruptible("nothing is kept"):
            import_module("loses_interrupts")
            Event().wait(20.0)

    with pytest.raises(InterruptedCommandError):
        load()


async def test_signals_call_a_function_on_the_loop_and_handlers_are_as_before() -> None:
    before, called = handlers(), []
    with on_signals(called.append):
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.raise_signal(number)
        await until(lambda: len(called) == 3)
    assert called == [signal.SIGTERM, signal.SIGINT, signal.SIGHUP]
    assert handlers() == before
