"""64-bit ticks from counters of 16 and 32 bits, with the races of their wraps, against a simulated timer."""

import random

import pytest
from c_reference import run_captures


def test_a_32_bit_timer_that_is_read_once_a_wrap() -> None:
    rng = random.Random(1)
    true, commands, expected = 2**32 - 5, ["clock 32 4294967291"], []
    offset = 2**32  # the first wrap is taken as past
    for _ in range(300):
        true += rng.choice((0, 1, 5, 1000, 2**31, 2**32 - 1))
        commands.append(f"update {true % 2**32}")
        expected.append(true + offset)
        for _ in range(3):
            capture = true + rng.choice((0, 1, -1, 2**31 - 1, -(2**31), rng.randrange(-(2**31), 2**31)))
            commands.append(f"at {capture % 2**32}")
            expected.append(capture + offset)
    assert list(map(int, run_captures(commands))) == expected


@pytest.mark.parametrize("bits", [16, 31])
def test_captures_beside_the_wrap_of_a_shorter_counter(bits: int) -> None:
    size = 1 << bits
    commands, expected = [f"clock {bits} {size - 1}"], []
    true = size - 1
    for step in (0, 1, 1, size // 2, size - 1):
        true += step
        commands.append(f"update {true % size}")
        expected.append(true + size)
        for behind in (0, 1, size // 2):
            commands.append(f"at {(true - behind) % size}")
            expected.append(true - behind + size)
        commands.append(f"at {(true + size // 2 - 1) % size}")
        expected.append(true + size // 2 - 1 + size)
    assert list(map(int, run_captures(commands))) == expected


class Timer:
    """A counter of some bits whose wrap sets a flag; its interrupt counts the wrap and clears the flag, later."""

    def __init__(self, bits: int, true: int) -> None:
        self.bits, self.true = bits, true
        self.wraps, self.pending = true >> bits, False

    def advance(self, ticks: int) -> None:
        before = self.true >> self.bits
        self.true += ticks
        self.pending |= self.true >> self.bits != before

    def interrupt(self) -> None:
        self.wraps += self.pending
        self.pending = False


@pytest.mark.parametrize("bits", [8, 16])
def test_wraps_that_are_counted_by_an_interrupt_have_no_race(bits: int) -> None:
    size = 1 << bits
    commands, expected = [], []
    raced = {"wrapped before the count": 0, "wrapped between count and flag": 0, "captured before the wrap": 0}
    for seed in range(4000):
        rng = random.Random(seed)
        timer = Timer(bits, 4 * size - rng.choice((1, 2, 3, 5, rng.randrange(1, size))))  # mostly just before a wrap
        timer.advance(rng.choice((0, 1, 2, 5)))
        capture = timer.true
        timer.advance(rng.choice((0, 1, 3, rng.randrange(size // 2 - 20))))
        if rng.random() < 0.5:
            timer.interrupt()
        # From here on the interrupt is masked: count, flag, wraps, with a few ticks between them.
        count = timer.true
        raced["wrapped before the count"] += timer.pending
        raced["captured before the wrap"] += capture >> bits != count >> bits
        flag_before = timer.pending
        timer.advance(rng.choice((0, 0, 1, 2, 5)))
        raced["wrapped between count and flag"] += timer.pending and not flag_before
        pending = timer.pending
        timer.advance(rng.choice((0, 1)))
        commands.append(f"extended {timer.wraps} {int(pending)} {count % size} {bits}")
        commands.append(f"captured {timer.wraps} {int(pending)} {count % size} {bits} {capture % size}")
        expected += [count, capture]
    assert min(raced.values()) > 10, raced
    assert list(map(int, run_captures(commands))) == expected
