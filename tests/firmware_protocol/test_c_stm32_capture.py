"""The STM32 board's input capture on a computer: a timer, captures and DMA in memory, against a model of lists."""

import random

from c_reference import C_FOLDER, common_sources, driver, reference_sources, run_driver
from test_c_capture import record_of

from firmware_protocol.layouts import RecordFlag, SingleToneRecord

STRIDE = 64
GATE = 84_000
START = 2**32 - 500_000  # the timer wraps within the run
OF_TICKS = 2**32  # the board's ticks begin behind one wrap


def run(commands: list[str]) -> list[str]:
    options = ("-DSTM32F4_FAKE", f"-I{C_FOLDER / 'stm32f4'}")
    return run_driver(
        driver("stm32_capture_driver", *common_sources(), *reference_sources(), options=options), commands
    )


def gate_of(line: str) -> tuple[int, int, list[SingleToneRecord]]:
    closed, end, *records = line.split()
    return int(closed), int(end), [SingleToneRecord(*map(int, record.split(","))) for record in records]


def stamps_until(until: int, channel: int) -> list[int]:
    rng = random.Random(channel)
    ticks, stamps = START - 20_000.0, []
    while ticks < until:
        stamps.append(round(ticks))
        ticks += 537.6 * (1 + 1e-3 * channel) + rng.uniform(-2, 2)
    return stamps


def play(commands: list[str], tones: list[list[int]], sent: list[int], until: int) -> None:
    for channel, stamps in enumerate(tones):
        while sent[channel] < len(stamps) and stamps[sent[channel]] <= until:
            commands.append(f"capture {channel} {stamps[sent[channel]] % 2**32}")
            sent[channel] += 1


def test_frames_are_the_sums_of_the_captures_in_each_gate() -> None:
    count = 60
    tones = [stamps_until(START + (count + 10) * GATE, channel) for channel in range(4)]
    rng, sent = random.Random(5), [0] * 4
    commands = [f"time {START % 2**32 - 30_000}", "run 84000"]  # so that the timer was read before
    play(commands, tones, sent, START)
    commands += [f"time {START % 2**32}", "run 84000"]
    now = START
    while now < START + (count + 6) * GATE:
        now += rng.choice((100, 20_000, 90_000, 300_000))  # at most 3.6 ms
        play(commands, tones, sent, now - rng.randrange(800))  # DMA is up to 10 us late
        commands.append(f"time {now % 2**32}")
        commands += ["gate"] * 5
    closes = [gate for gate in map(gate_of, run(commands)[2:]) if gate[0]]
    assert len(closes) >= count
    before = [sum(t < START for t in stamps) for stamps in tones]
    for number, (closed, end, records) in enumerate(closes):
        low = START + number * GATE
        assert (closed, end) == (1, low + GATE + OF_TICKS)
        for channel, (stamps, record) in enumerate(zip(tones, records, strict=True)):
            # Edges of the time before the run do not count.
            numbered = [(k - before[channel] + 1, t) for k, t in enumerate(stamps) if low <= t < low + GATE]
            flags = RecordFlag.STRIDE_BREAK if number == 0 else 0
            assert record == record_of([(STRIDE * edge, t) for edge, t in numbered], flags, STRIDE)


def test_a_loop_that_was_stopped_misses_whole_gates_and_goes_on() -> None:
    tones = [stamps_until(START + 60 * GATE, channel) for channel in range(4)]
    sent = [0] * 4
    commands: list[str] = [f"time {START % 2**32}"]
    play(commands, tones, sent, START)
    commands.append("run 84000")
    moments = [START + GATE // 2, START + 20 * GATE + 5000, *(START + k * GATE + 5000 for k in range(21, 26))]
    for now in moments:
        play(commands, tones, sent, now)
        commands.append(f"time {now % 2**32}")
        commands += ["gate"] * 25
    closes = [gate for gate in map(gate_of, run(commands)[1:]) if gate[0]]
    assert [closed for closed, _, _ in closes] == [-1] * 20 + [1] * 5
    flags = [[record.flags for record in records] for closed, _, records in closes if closed == 1]
    assert all(flag & RecordFlag.LOST_EDGE for flag in flags[0])
    assert flags[1] == [RecordFlag.STRIDE_BREAK] * 4
    assert flags[2:] == [[0] * 4] * 3


def test_a_capture_that_the_timer_overwrote_is_a_lost_edge_on_its_channel() -> None:
    tones = [stamps_until(START + 60 * GATE, channel) for channel in range(4)]
    sent = [0] * 4
    commands: list[str] = [f"time {START % 2**32}"]
    play(commands, tones, sent, START)
    commands.append("run 84000")
    for k in range(1, 5):
        if k == 2:
            commands.append("over 3")
        play(commands, tones, sent, START + k * GATE + 5000)
        commands += [f"time {(START + k * GATE + 5000) % 2**32}", "gate"]
    flags = [[record.flags for record in gate_of(line)[2]] for line in run(commands)[1:]]
    assert [bool(flag & RecordFlag.LOST_EDGE) for flag in flags[1]] == [False, False, False, True]
    assert flags[2] == [0, 0, 0, RecordFlag.STRIDE_BREAK]
    assert flags[3] == [0] * 4
