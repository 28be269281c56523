"""Frame numbers through loss, wrap, outage and reboot: every missing gate has one cause."""

from resonator_daemon.acquisition.clock import Instant
from resonator_daemon.acquisition.frames import FrameLoss, Gap
from resonator_daemon.acquisition.numbering import FrameNumbering

GATE_TICKS = 1000
GATE_NS = 1_000_000
FRAME_BYTES = 204


def numbering() -> FrameNumbering:
    fresh = FrameNumbering(FRAME_BYTES, GATE_TICKS, GATE_NS)
    fresh.started()
    return fresh


def accept(
    it: FrameNumbering, sequence: int, *, boot_id: int = 1, gate: int | None = None
) -> tuple[int, Gap | None] | None:
    gate = sequence if gate is None else gate
    return it.accept(1, sequence, gate * GATE_TICKS, Instant(gate * GATE_NS, 100))


def test_no_gap_without_loss() -> None:
    it = numbering()
    assert [accept(it, n) for n in range(3)] == [(0, None), (1, None), (2, None)]


def test_frames_that_never_came_are_a_link_gap() -> None:
    it = numbering()
    accept(it, 0)
    assert accept(it, 4) == (4, Gap(1, FrameLoss(link_gap=3)))


def test_discarded_bytes_tell_how_many_came_damaged() -> None:
    it = numbering()
    accept(it, 0)
    it.discarded(2 * FRAME_BYTES)
    assert accept(it, 4) == (4, Gap(1, FrameLoss(damaged=2, link_gap=1)))
    it.discarded(100)  # part of a frame
    assert accept(it, 6) == (6, Gap(5, FrameLoss(damaged=1)))
    it.discarded(50)  # no frame is missing: it was something else
    assert accept(it, 7) == (7, None)
    assert accept(it, 9) == (9, Gap(8, FrameLoss(link_gap=1)))


def test_what_the_board_dropped_is_its_own_cause_and_counted_once() -> None:
    it = numbering()
    accept(it, 0)
    it.dropped_by_board(5)
    assert accept(it, 6) == (6, Gap(1, FrameLoss(board_overflow=5)))
    it.dropped_by_board(5)
    assert accept(it, 9) == (9, Gap(7, FrameLoss(link_gap=2)))
    it.dropped_by_board(6)
    assert accept(it, 12) == (12, Gap(10, FrameLoss(board_overflow=1, link_gap=1)))


def test_the_number_wraps_and_the_index_does_not() -> None:
    it = numbering()
    it.started()
    it._next_sequence = 2**32 - 1
    it._next_index = 2**32 - 1
    assert accept(it, 2**32 - 1) == (2**32 - 1, None)
    assert accept(it, 2) == (2**32 + 2, Gap(2**32, FrameLoss(link_gap=2)))


def test_a_frame_that_was_there_already_is_ignored() -> None:
    it = numbering()
    accept(it, 0)
    accept(it, 1)
    assert accept(it, 1) is None
    assert accept(it, 2) == (2, None)


def test_an_outage_is_a_gap_and_no_shift_of_time() -> None:
    it = numbering()
    accept(it, 0)
    it.started()
    assert accept(it, 0, gate=500) == (500, Gap(1, FrameLoss(link_gap=499)))
    assert accept(it, 1, gate=501) == (501, None)


def test_after_a_reboot_the_hosts_clock_tells_the_outage() -> None:
    it = numbering()
    it.accept(1, 0, 10**12, Instant(0, 100))
    it.started()
    index, gap = it.accept(2, 0, GATE_TICKS, Instant(700 * GATE_NS + 80_000, 100)) or (None, None)
    assert (index, gap) == (700, Gap(1, FrameLoss(link_gap=699)))


def test_frames_lost_right_after_the_return_are_not_counted_twice() -> None:
    it = numbering()
    accept(it, 0)
    it.started()
    it.discarded(FRAME_BYTES)
    assert accept(it, 1, gate=501) == (501, Gap(1, FrameLoss(damaged=1, link_gap=499)))
