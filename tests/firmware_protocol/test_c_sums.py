"""The sums of resonator_sums.h against sums over lists."""

import random
import struct

import pytest
from c_reference import run_commands
from test_c_capture import record_of


def sums_line(stamps: list[tuple[int, int]], stride_edges: int) -> str:
    return " ".join(map(str, ("sums", *record_of(stamps, 0, stride_edges)[:8], 1)))


def command(stamps: list[tuple[int, int]], stride_edges: int) -> str:
    raw = b"".join(struct.pack("<II", edge % 2**32, ticks % 2**32) for edge, ticks in stamps)
    return f"sums {stride_edges} {raw.hex() or '-'}"


def jittered(rng: random.Random, count: int, start: int, period: int, jitter: int) -> list[tuple[int, int]]:
    edge = rng.randrange(2**33)
    return [(edge + 16 * k, start + k * period + rng.randint(-jitter, jitter)) for k in range(count)]


@pytest.mark.parametrize("start", [0x1000, 2**32 - 30_000])
def test_sums_are_exact_also_across_the_wrap(start: int) -> None:
    gates = []
    for seed in range(300):
        rng = random.Random(seed)
        period = rng.choice((50, 3_000, 100_000))
        gates.append(jittered(rng, rng.choice((0, 1, 2, 3, 40)), start, period, rng.choice((0, 1, period // 2))))
    printed = run_commands([command(gate, 16) for gate in gates])
    assert printed == [sums_line(gate, 16) for gate in gates]


def test_longest_record_and_one_stamp_more() -> None:
    stamps = jittered(random.Random(3), 65_536, 5, 65_000, 300)
    full, over = run_commands([command(stamps[:-1], 1), command(stamps, 1)])
    assert full == sums_line(stamps[:-1], 1)
    assert over == full[:-1] + "0"


def test_nonsense_stays_at_the_limit() -> None:
    stamps = [(0, 0), (1, 1), (2, 2**32), (3, 2**32), (4, 2**33 - 1), (5, 2**33 - 1)]
    (line,) = run_commands([command(stamps, 1)])
    assert int(line.split()[8]) == 2**64 - 1
