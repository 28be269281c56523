"""A long run that ends, by itself or by Ctrl-C: the board that is there then ends in order, and is judged as well."""

import asyncio
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import long_run
import pytest
from long_run import Run
from long_run_faults import BoardLeg

HEALTH: dict[str, Any] = {"frames": 100, "connections": 1, "packets_ignored": {}}


class Board:
    """Has sent 40 frames whole whenever it ends in order, and says so then as an emulator does."""

    def __init__(self, log: Path) -> None:
        self.log = log
        self.started = asyncio.Event()
        self.ended_by: list[signal.Signals] = []
        self.running = False

    def start(self) -> None:
        self.running = True
        self.started.set()

    def end(self, number: signal.Signals) -> bool:
        self.ended_by.append(number)
        self.running = False
        if number is signal.SIGINT:
            account = {"frames_made": 41, "frames_sent": 40, "faults": {"frames_hit": 0}}
            self.log.write_text(json.dumps(account) + "\n")
        return True


class Listener:
    """Tells of 40 more frames each time it is asked."""

    def __init__(self) -> None:
        self._frames = 100

    def next_health(self, _timeout_s: float) -> dict[str, Any]:
        self._frames += 40
        return HEALTH | {"frames": self._frames}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    monkeypatch.setattr(long_run, "_GONE_S", (0.0, 0.0))
    made = Run(tmp_path, 1, lambda _: None)
    made._listener.close()
    monkeypatch.setattr(made, "_listener", Listener())
    return made


@pytest.mark.parametrize("to_be_killed", [False, True])
async def test_a_leg_that_is_cut_short_ends_in_order_and_is_judged(
    run: Run, monkeypatch: pytest.MonkeyPatch, to_be_killed: bool
) -> None:
    board = Board(run._folder / "board.log")
    monkeypatch.setattr(run, "_make_board", lambda _: board)
    monkeypatch.setattr(long_run, "draw_leg", lambda _: BoardLeg(3600.0, "", frozenset(), killed=to_be_killed))
    boards = asyncio.create_task(run._change_boards())
    await board.started.wait()
    assert not boards.done()
    run.cut_short()
    await boards
    assert board.ended_by == [signal.SIGINT]
    assert [(leg.sent, leg.arrived, leg.missing) for leg in run.seen.legs] == [(40, 40, 0)]
    assert run.seen.cut_short


async def test_a_board_that_is_killed_in_its_turn_gives_no_account(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    board = Board(run._folder / "board.log")
    legs = iter([BoardLeg(0.0, "", frozenset(), killed=True), BoardLeg(3600.0, "", frozenset(), killed=False)])
    second = asyncio.Event()

    def draw(_: object) -> BoardLeg:
        leg = next(legs)
        if not leg.killed:
            second.set()
        return leg

    monkeypatch.setattr(run, "_make_board", lambda _: board)
    monkeypatch.setattr(long_run, "draw_leg", draw)
    boards = asyncio.create_task(run._change_boards())
    await second.wait()
    run.cut_short()
    await boards
    assert board.ended_by == [signal.SIGKILL, signal.SIGINT]
    assert len(run.seen.legs) == 1
