"""The RP2040 board's capture on a computer: PIO words, DMA and the PWM clock in memory, against a model of lists."""

import random
from pathlib import Path

import pytest
from c_reference import C_FOLDER, common_sources, driver, reference_sources, run_driver
from test_c_capture import record_of
from test_c_stm32_capture import gate_of

from firmware_protocol.layouts import RecordFlag

FAKES = Path(__file__).parents[1] / "firmware" / "pico_sdk"
STRIDE = 200
GATE = 62_500
OF_TICKS = 2**32  # the board's ticks begin behind one wrap


def run(commands: list[str]) -> list[str]:
    options = (f"-I{FAKES}", f"-I{C_FOLDER / 'rp2040'}")
    return run_driver(
        driver("rp2040_capture_driver", *common_sources(), *reference_sources(), options=options), commands
    )


class Bench:
    """Commands of a board with four tones; `start` is the tick at which its run begins."""

    def __init__(self, start: int, until: int) -> None:
        self.commands = [f"time {start} 1"]
        self.start = start
        self.tones = []
        for channel in range(4):
            rng = random.Random(channel)
            ticks, stamps = start + rng.uniform(1, 1000), []
            while ticks < until:
                stamps.append(round(ticks))
                ticks += 1250.0 * (1 + 1e-3 * channel) + rng.uniform(-2, 2)
            self.tones.append(stamps)
        self._sent = [0] * 4

    def play(self, until: int) -> None:
        """Let the state machines write their words up to this tick."""
        for channel, stamps in enumerate(self.tones):
            while self._sent[channel] < len(stamps) and stamps[self._sent[channel]] <= until:
                self.commands.append(f"edge {channel} {stamps[self._sent[channel]]}")
                self._sent[channel] += 1


@pytest.mark.parametrize("start", [10_000, 2**32 - 700_000])  # the count of 32 bits wraps within the run
def test_frames_are_the_sums_of_the_words_in_each_gate(start: int) -> None:
    count = 60
    bench, rng = Bench(start, start + (count + 20) * GATE), random.Random(5)
    bench.commands.append(f"run {GATE}")
    now = start
    while now < start + (count + 6) * GATE:
        # Close to a wrap of the PWM counter, too, with its interrupt served or not yet.
        now += rng.choice((100, 20_000, 65_536 - now % 65_536, 65_537 - now % 65_536, 300_000))
        bench.play(now - rng.randrange(500))
        bench.commands.append(f"time {now} {int(rng.random() < 0.5 or now % 65_536 > 20_000)}")
        bench.commands += ["gate"] * 6
    closes = [gate for gate in map(gate_of, run(bench.commands)[1:]) if gate[0]]
    assert len(closes) >= count
    for number, (closed, end, records) in enumerate(closes):
        low = start + number * GATE
        assert (closed, end) == (1, low + GATE + OF_TICKS)
        for stamps, record in zip(bench.tones, records, strict=True):
            numbered = [((k + 1) * STRIDE, t) for k, t in enumerate(stamps) if low <= t < low + GATE]
            assert record == record_of(numbered, RecordFlag.STRIDE_BREAK if number == 0 else 0, STRIDE)


def test_a_word_that_a_full_fifo_lost_begins_the_counting_anew() -> None:
    start = 10_000
    bench = Bench(start, start + 40 * GATE)
    bench.commands.append(f"run {GATE}")
    for k in range(1, 6):
        now = start + k * GATE + 5000
        bench.play(now)
        bench.commands.append(f"time {now} 1")
        if k == 2:
            bench.commands.append("stall 1")
        bench.commands.append("gate")
    closes = [gate_of(line) for line in run(bench.commands)[1:]]
    flags = [[record.flags for record in records] for _, _, records in closes]
    assert all(flag & RecordFlag.LOST_EDGE for flag in flags[1])
    assert flags[2] == [RecordFlag.STRIDE_BREAK] * 4
    assert flags[3:] == [[0] * 4] * 2
    for k in (2, 3, 4):  # and the stamps are true again
        low = start + k * GATE
        for stamps, record in zip(bench.tones, closes[k][2], strict=True):
            seen = [t for t in stamps if low <= t < low + GATE and t > start + 2 * GATE + 5000]
            assert (record.first_ticks, record.stamps) == (seen[0] % 2**32, len(seen))


def test_a_loop_that_was_stopped_misses_whole_gates_and_goes_on() -> None:
    start = 10_000
    bench = Bench(start, start + 60 * GATE)
    bench.commands.append(f"run {GATE}")
    for now in (start + GATE // 2, start + 20 * GATE + 5000, *(start + k * GATE + 5000 for k in range(21, 25))):
        bench.play(now)
        bench.commands.append(f"time {now} 1")
        bench.commands += ["gate"] * 25
    closes = [gate for gate in map(gate_of, run(bench.commands)[1:]) if gate[0]]
    assert [closed for closed, _, _ in closes] == [-1] * 20 + [1] * 4
    assert [record.flags for record in closes[-1][2]] == [0] * 4
