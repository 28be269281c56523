"""The RP2040's capture program, run cycle by cycle, and its words in ticks, against the edges that were on the pin."""

import bisect
import random

import pytest
from c_reference import C_FOLDER, run_captures
from pio_machine import PioMachine

CYCLES_PER_TICK = 2
PROGRAM = C_FOLDER / "rp2040" / "capture.pio"


def rising_edges(rng: random.Random, period: float, jitter: float, until: int) -> list[float]:
    edges, cycle = [], rng.uniform(20.0, 40.0)
    while cycle < until:
        edges.append(cycle + rng.uniform(-jitter, jitter))
        cycle += period
    return edges


@pytest.mark.parametrize(
    ("period", "duty", "jitter", "stride"),
    [
        (12.5, 0.5, 0.0, 7),  # 10 MHz at 125 MHz
        (12.5123, 0.5, 0.4, 200),
        (12.51, 0.4, 0.2, 1),
        (10.5, 0.5, 0.0, 16),
        (1000.3, 0.1, 3.0, 3),
    ],
)
@pytest.mark.parametrize("start_ticks", [0, 2**32 - 3000])  # the count wraps within the run
def test_each_word_is_the_tick_of_its_edge(
    period: float, duty: float, jitter: float, stride: int, start_ticks: int
) -> None:
    until = 60_000
    rng = random.Random(f"{period} {stride}")
    edges = rising_edges(rng, period, jitter, until)

    def pin(cycle: int) -> bool:
        number = bisect.bisect_right(edges, cycle) - 1
        return number >= 0 and cycle < edges[number] + duty * period

    machine = PioMachine(PROGRAM, pin, x=-(start_ticks + stride) % 2**32, osr=stride - 1)
    machine.run(until)
    assert len(machine.pushed) == pytest.approx(len(edges) / stride, abs=1.01)

    # One gate over all; the first ticks of records of one stamp each are those of the words.
    clock = 2**32 + start_ticks
    commands = [f"clock 32 {start_ticks % 2**32}", f"ring 10 1 {stride + 2}"]
    for number, (cycle, word) in enumerate(machine.pushed[:1000]):
        now = clock + cycle // CYCLES_PER_TICK
        commands += [f"update {now % 2**32}", f"begin {now - 50_000} 100000 1", f"word {number} {word}"]
        commands += [f"sort {number + 1} 0", "close"]
    printed = [line for line in run_captures(commands) if "," in line]
    ticks = [int(line.split()[1].split(",")[1]) for line in printed]
    late = [
        (tick - start_ticks) % 2**32 - edges[(number + 1) * stride - 1] / CYCLES_PER_TICK
        for number, tick in enumerate(ticks)
    ]
    assert len(late) > 5
    assert max(late) - min(late) <= 1.0 + 1e-9  # rounding to a tick, and nothing that grows with the number of edges
    assert 0 <= min(late) < 3  # the same for all words, and so of no effect on a frequency


def test_a_slow_edge_that_stays_high_is_counted_once() -> None:
    machine = PioMachine(PROGRAM, lambda cycle: 100 <= cycle % 500 < 400, x=0, osr=0)
    machine.run(10_000)
    assert len(machine.pushed) == 20
