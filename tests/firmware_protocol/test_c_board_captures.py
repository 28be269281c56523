"""The captures of the RP2040 and STM32 boards: words, DMA and clocks in memory, against a model of lists."""

import random
from pathlib import Path
from typing import NamedTuple

import pytest
from c_reference import C_FOLDER, common_sources, driver, reference_sources, run_driver
from test_c_capture import record_of

from firmware_protocol.layouts import RecordFlag, SingleToneRecord

FAKES = Path(__file__).parents[1] / "firmware" / "pico_sdk"
OF_TICKS = 2**32  # the board's ticks begin behind one wrap


class Board(NamedTuple):
    """Board whose run begins at the tick `start`, and its tones so many ticks before."""

    driver: str
    options: tuple[str, ...]
    word: str  # command for one capture
    stride: int
    gate: int
    period: float
    before: int
    start: int


RP2040 = Board(
    "rp2040_capture_driver", (f"-I{FAKES}", f"-I{C_FOLDER / 'rp2040'}"), "edge", 200, 62_500, 1250.0, 0, 10_000
)
RP2040_WRAPS = RP2040._replace(start=2**32 - 700_000)  # the count of 32 bits wraps within the run
STM32 = Board(
    *("stm32_capture_driver", ("-DSTM32F4_FAKE", f"-I{C_FOLDER / 'stm32f4'}"), "capture", 64, 84_000, 537.6, 20_000),
    start=2**32 - 500_000,
)


class Bench:
    """Commands to the driver of a board with four tones, from the start of its run."""

    def __init__(self, board: Board, gates: int) -> None:
        self.board, self._sent, self._gates = board, [0] * 4, 0
        self.tones = [self._stamps(channel, board.start + gates * board.gate) for channel in range(4)]
        self.commands = [f"time {board.start % 2**32 - 30_000}", f"run {board.gate}"] if board.before else []
        self.play(board.start)
        self.commands += [self._time(board.start), f"run {board.gate}"]

    def _stamps(self, channel: int, until: int) -> list[int]:
        rng, stamps = random.Random(channel), list[int]()
        ticks = self.board.start - self.board.before + rng.uniform(1, 1000)
        while ticks < until:
            stamps.append(round(ticks))
            ticks += self.board.period * (1 + 1e-3 * channel) + rng.uniform(-2, 2)
        return stamps

    def _time(self, now: int, served: bool = True) -> str:
        return f"time {now} {int(served)}" if self.board.word == "edge" else f"time {now % 2**32}"

    def play(self, until: int) -> None:
        """Capture up to this tick."""
        wrap = 2**64 if self.board.word == "edge" else 2**32
        for channel, stamps in enumerate(self.tones):
            while self._sent[channel] < len(stamps) and stamps[self._sent[channel]] <= until:
                self.commands.append(f"{self.board.word} {channel} {stamps[self._sent[channel]] % wrap}")
                self._sent[channel] += 1

    def close(self, now: int, gates: int, late: int = 0, served: bool = True) -> None:
        """Run the main loop so often; captures are `late` ticks behind, the interrupt of the clock is served or not."""
        self.play(now - late)
        self.commands += [self._time(now, served), *["gate"] * gates]
        self._gates += gates

    def closes(self) -> list[tuple[int, int, list[SingleToneRecord]]]:
        """Return result, end and records of each gate that was closed."""
        sources = (*common_sources(), *reference_sources())
        printed = run_driver(driver(self.board.driver, *sources, options=self.board.options), self.commands)
        lines = (line.split() for line in printed[-self._gates :])
        found = [
            (int(closed), int(end), [SingleToneRecord(*map(int, record.split(","))) for record in records])
            for closed, end, *records in lines
        ]
        return [gate for gate in found if gate[0]]


def flags_of(closes: list[tuple[int, int, list[SingleToneRecord]]]) -> list[list[int]]:
    return [[record.flags for record in records] for closed, _, records in closes if closed == 1]


@pytest.mark.parametrize("board", [RP2040, RP2040_WRAPS, STM32], ids=["rp2040", "rp2040-wraps", "stm32"])
def test_frames_are_the_sums_of_the_captures_in_each_gate(board: Board) -> None:
    count, gate, rng, now = 60, board.gate, random.Random(5), board.start
    bench = Bench(board, count + 20)
    while now < board.start + (count + 6) * gate:
        # Close to a wrap of the PWM counter of the RP2040, too, with its interrupt served or not yet.
        now += rng.choice((100, 20_000, 65_536 - now % 65_536, 65_537 - now % 65_536, 300_000))
        bench.close(now, 6, late=rng.randrange(500), served=rng.random() < 0.5 or now % 65_536 > 20_000)
    closes = bench.closes()
    assert len(closes) >= count
    before = [sum(t < board.start for t in stamps) for stamps in bench.tones]  # the run does not count them
    for number, (closed, end, records) in enumerate(closes):
        low = board.start + number * gate
        assert (closed, end) == (1, low + gate + OF_TICKS)
        for first, stamps, record in zip(before, bench.tones, records, strict=True):
            numbered = [((k - first + 1) * board.stride, t) for k, t in enumerate(stamps) if low <= t < low + gate]
            assert record == record_of(numbered, RecordFlag.STRIDE_BREAK if number == 0 else 0, board.stride)


@pytest.mark.parametrize("board", [RP2040, STM32], ids=["rp2040", "stm32"])
def test_a_loop_that_was_stopped_misses_whole_gates_and_goes_on(board: Board) -> None:
    bench = Bench(board, 60)
    for after in (board.gate // 2, 20 * board.gate + 5000, *(k * board.gate + 5000 for k in range(21, 26))):
        bench.close(board.start + after, 25)
    closes = bench.closes()
    assert [closed for closed, _, _ in closes] == [-1] * 20 + [1] * 5
    first, second, *others = flags_of(closes)
    assert all(flag & RecordFlag.LOST_EDGE for flag in first)
    assert second == [RecordFlag.STRIDE_BREAK] * 4
    assert others == [[0] * 4] * 3


def test_a_word_that_a_full_fifo_lost_begins_the_counting_anew() -> None:
    start, gate = RP2040.start, RP2040.gate
    bench = Bench(RP2040, 40)
    for k in range(1, 6):
        bench.close(start + k * gate + 5000, 0)
        bench.commands += ["stall 1"] * (k == 2)
        bench.close(start + k * gate + 5000, 1)
    closes = bench.closes()
    flags = flags_of(closes)
    assert all(flag & RecordFlag.LOST_EDGE for flag in flags[1])
    assert flags[2] == [RecordFlag.STRIDE_BREAK] * 4
    assert flags[3:] == [[0] * 4] * 2
    for k in (2, 3, 4):  # and the stamps are true again
        low = start + k * gate
        for stamps, record in zip(bench.tones, closes[k][2], strict=True):
            seen = [t for t in stamps if low <= t < low + gate and t > start + 2 * gate + 5000]
            assert (record.first_ticks, record.stamps) == (seen[0] % 2**32, len(seen))


def test_a_capture_that_the_timer_overwrote_is_a_lost_edge_on_its_channel() -> None:
    bench = Bench(STM32, 60)
    for k in range(1, 5):
        bench.commands += ["over 3"] * (k == 2)
        bench.close(STM32.start + k * STM32.gate + 5000, 1)
    flags = flags_of(bench.closes())
    assert [bool(flag & RecordFlag.LOST_EDGE) for flag in flags[1]] == [False, False, False, True]
    assert flags[2] == [0, 0, 0, RecordFlag.STRIDE_BREAK]
    assert flags[3] == [0] * 4
