"""When the reader looks at a link: often enough for its buffers, and seldom before a step is complete."""

import random

from resonator_daemon.board.session.board_reader import StepPacing

MS = 1_000_000
FRAME_BYTES = 204


def frame(index: int) -> tuple[int, int]:
    """Return index and middle of a frame whose gate, of 1 ms, ends at `index` + 1 milliseconds."""
    return index, index * MS + MS // 2


def test_sleeps_until_the_last_frame_of_the_step_has_come() -> None:
    pacing = StepPacing(FRAME_BYTES, MS)
    assert pacing.sleep_ns(5 * MS, *frame(4), (5,), 100 * MS) == 5 * MS
    assert pacing.sleep_ns(6 * MS, *frame(5), (3, 5), 100 * MS) == 3 * MS  # frames 5 and 8 end steps, counted from 0
    assert pacing.sleep_ns(5 * MS, *frame(4), (5,), 7 * MS) == 2 * MS  # the reader has something else to do
    assert pacing.sleep_ns(30 * MS, *frame(4), (5,), 100 * MS) == 0  # it is late already


def test_a_long_step_is_read_before_the_buffer_of_a_terminal_is_full() -> None:
    for frame_bytes, frame_ns in ((204, MS), (2000, 10 * MS), (1000, MS)):
        sleep_ns = StepPacing(frame_bytes, frame_ns).sleep_ns(0, *frame(0), (1000,), 10**12)
        assert sleep_ns * frame_bytes / frame_ns <= 4096 / 2


def test_one_read_in_six_comes_before_the_step_is_complete_whatever_the_link_delays() -> None:
    seeded = random.Random(1)
    pacing = StepPacing(FRAME_BYTES, MS)
    early = late_ns = 0
    for step in range(4, 10_000, 5):  # each step ends with a frame that can be read 0.2 to 0.4 ms after its gate
        now_ns = (step + 1) * MS + seeded.randrange(MS)
        now_ns += pacing.sleep_ns(now_ns, *frame(step), (5,), 10**12)
        readable_ns = (step + 6) * MS + seeded.randrange(200_000, 400_000)
        complete = now_ns >= readable_ns
        pacing.has_read(step + 5 if complete else step + 4)
        if step > 1000:
            early += not complete
            late_ns += max(0, now_ns - readable_ns)
    assert 0.12 < early / 1800 < 0.22
    assert late_ns / 1800 < 100_000
