"""Captured counts into gates and records, against a model of lists that knows every stamp's 64-bit ticks."""

import random
from dataclasses import dataclass, field

import pytest
from c_reference import run_captures

from firmware_protocol.layouts import RecordFlag, SingleToneRecord

STRIDE = 8
RING_BITS = 6
START = 2**32 + 2**32 - 7000  # the counter wraps within the run


def record_of(stamps: list[tuple[int, int]], flags: int, stride: int = STRIDE) -> SingleToneRecord:
    """Return the sums of (edge, ticks), by their definition."""
    if not stamps:
        return SingleToneRecord(*[0] * 9, flags | RecordFlag.NO_SIGNAL)
    ticks = [t for _, t in stamps]
    x = [t - ticks[0] for t in ticks]
    q2 = sum((c - 2 * b + a) ** 2 for a, b, c in zip(ticks, ticks[1:], ticks[2:], strict=False))
    sums = (sum(x), sum(k * each for k, each in enumerate(x)), q2)
    return SingleToneRecord(stamps[0][0] % 2**32, ticks[0] % 2**32, len(stamps), stride, x[-1], *sums, 0, flags)


def printed_records(line: str) -> tuple[int, list[SingleToneRecord]]:
    end, *records = line.split()
    return int(end), [SingleToneRecord(*map(int, record.split(","))) for record in records]


@dataclass
class Tone:
    """Stamps of one channel: when each stride-th edge falls, in 64-bit ticks, with silences."""

    rng: random.Random
    until: int
    stamps: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        period, ticks = self.rng.choice((90.3, 400.7, 999.99)), float(START - self.rng.randrange(3000))
        while ticks < self.until:
            self.stamps.append(round(ticks))
            ticks += period + self.rng.uniform(-3, 3)
            if self.rng.random() < 0.003:
                ticks += self.rng.randrange(15_000)  # nothing to capture for a while


def expected_gates(tones: list[Tone], gate: int, count: int) -> list[list[SingleToneRecord]]:
    gates = []
    silent_before = [True] * 4  # a run begins with a stride break
    for number in range(count):
        low = START + number * gate
        records = []
        for channel, tone in enumerate(tones):
            numbered = [((k + 1) * STRIDE, t) for k, t in enumerate(tone.stamps) if low <= t < low + gate]
            records.append(record_of(numbered, RecordFlag.STRIDE_BREAK if silent_before[channel] else 0))
            silent_before[channel] = not numbered
        gates.append(records)
    return gates


@pytest.mark.parametrize("down", [False, True])
def test_whatever_the_main_loop_is_late_by_records_are_those_of_the_stamps(down: bool) -> None:
    """The loop reads the time, then each ring, at random moments; DMA brings words some ticks late."""
    gate, lag, missed = 5000, 60, 7 if down else 0
    silences = 0
    for seed in range(40):
        rng = random.Random(seed)
        count = 12
        tones = [Tone(random.Random(f"{seed} {channel}"), START + (count + 3) * gate) for channel in range(4)]
        expected = expected_gates(tones, gate, count)
        silences += sum(record.stamps == 0 for records in expected for record in records)
        got = [play_channel(rng, tones, channel, gate, lag, missed, count) for channel in range(4)]
        for number in range(count):
            assert [got[channel][number][1] for channel in range(4)] == expected[number], (seed, number)
            assert {got[channel][number][0] for channel in range(4)} == {START + (number + 1) * gate}
    assert silences > 5


def play_channel(
    rng: random.Random, tones: list[Tone], channel: int, gate: int, lag: int, missed: int, count: int
) -> list[tuple[int, SingleToneRecord]]:
    """Play one channel through its ring; return the ends of its gates and its records."""
    stamps = tones[channel].stamps
    commands = [f"clock 32 {START % 2**32}", f"ring {RING_BITS} {int(missed > 0)} {missed}"]
    commands.append(f"begin {START} {gate} {STRIDE}")
    now, written, closed = START, 0, 0
    kinds: list[str] = []
    while closed < count:
        now += rng.choice((1, 50, 700, 2500))
        commands.append(f"update {now % 2**32}")
        kinds.append("ticks")
        # DMA lags by less than `lag`, and goes on between the reading of the time and that of the ring.
        arrived = now - rng.randrange(lag) + rng.choice((0, 0, 40, 200))
        while written < len(stamps) and stamps[written] <= arrived:
            word = stamps[written] if not missed else -(stamps[written] - written * missed)
            commands.append(f"word {written} {word % 2**32}")
            written += 1
        commands.append(f"sort {written} {channel}")
        kinds.append("read")
        while now >= START + (closed + 1) * gate + lag and closed < count:
            commands += [f"due {now} {lag}", "close", f"sort {written} {channel}"]
            kinds += ["due", "close", "read"]
            closed += 1
        commands.append(f"due {now} {lag}")
        kinds.append("due not" if closed < count else "due any")
    printed = dict(enumerate(run_captures(commands)))
    assert len(printed) == len(kinds)
    for line, kind in enumerate(kinds):
        if kind in ("due", "due not"):
            assert printed[line] == str(int(kind == "due"))
    closes = [printed_records(printed[line]) for line, kind in enumerate(kinds) if kind == "close"]
    return [(end, records[channel]) for end, records in closes]


def test_words_that_were_overwritten_are_lost_edges_and_a_stride_break() -> None:
    stamps = [START + 100 * k for k in range(1, 200)]
    commands = [f"clock 32 {START % 2**32}", f"ring {RING_BITS} 0 0", f"begin {START} 5000 {STRIDE}"]

    def write(first: int, last: int) -> None:
        commands.extend(f"word {k} {stamps[k] % 2**32}" for k in range(first, last))

    write(0, 10)
    commands.append("sort 10 0")
    write(10, 10 + 61)  # one more than the ring keeps besides what may be overwritten just now
    commands += [f"update {stamps[70] % 2**32}", "sort 71 0", "close"]
    write(71, 110)
    commands += ["sort 110 0", "close", "sort 110 0"]
    write(110, 150)
    commands += [f"update {stamps[149] % 2**32}", "sort 150 0", "close"]
    printed = run_captures(commands)
    closes = [printed_records(line)[1][0] for line in printed if "," in line]
    assert closes[0].flags & RecordFlag.LOST_EDGE
    assert closes[1].flags == RecordFlag.STRIDE_BREAK
    assert closes[2].flags == 0
    assert closes[2].first_edge == closes[1].first_edge + closes[1].stamps * STRIDE
    assert (closes[2].first_ticks, closes[2].stamps) == ((START + 10_000) % 2**32, 50)


def test_a_stamp_behind_its_gate_is_a_lost_edge() -> None:
    commands = [
        f"begin {START} 5000 {STRIDE}", f"add 2 {START - 1}", f"add 2 {START}", "close", f"add 2 {START + 4999}"
    ]  # fmt: skip
    commands += [f"add 2 {START + 5000}", "close", f"add 2 {START + 10000}", f"add 2 {START + 15000}", "close"]
    printed = run_captures(commands)
    records = [printed_records(line)[1][2] for line in printed if "," in line]
    assert [record.flags for record in records] == [
        RecordFlag.STRIDE_BREAK,
        RecordFlag.LOST_EDGE | RecordFlag.NO_SIGNAL,
        RecordFlag.STRIDE_BREAK,
    ]
    assert [record.stamps for record in records] == [1, 0, 1]
    assert printed[-2] == "0"  # beyond the open gate: it is kept


def test_gates_that_were_skipped_break_the_stride() -> None:
    commands = [f"begin {START} 5000 {STRIDE}", f"add 0 {START}", "close", "skip", "skip"]
    commands += [f"add 0 {START + 15000}", "close"]
    end, records = printed_records(run_captures(commands)[-1])
    assert end == START + 20000
    assert records[0].flags == RecordFlag.STRIDE_BREAK
    assert records[0].stamps == 1


def test_a_record_that_is_full_overflows() -> None:
    commands = [f"begin {START} {2**31} 1", *(f"add 1 {START + 2 * k}" for k in range(65_536)), "close"]
    _, records = printed_records(run_captures(commands)[-1])
    assert records[1].flags == RecordFlag.OVERFLOW | RecordFlag.STRIDE_BREAK
    assert records[1].stamps == 65_535
