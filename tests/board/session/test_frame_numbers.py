"""Frame numbers through loss, wrap, outage and reboot: every missing gate has one cause."""

import pytest

from firmware_protocol.host import Frame
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frame_numbers import Accepted, BrokenSpacingError, FrameNumbering, NumberingSnapshot
from resonator_daemon.board.session.frames import FrameLoss, Gap

GATE_TICKS = 1000
GATE_NS = 1_000_000
FRAME_BYTES = 204


def numbering() -> FrameNumbering:
    fresh = FrameNumbering(FRAME_BYTES, GATE_TICKS, GATE_NS)
    fresh.started(0)
    return fresh


def at(gate: float, *, utc_step_ns: int = 0) -> Instant:
    now_ns = round(gate * GATE_NS)
    return Instant(now_ns + utc_step_ns, 100, now_ns, now_ns)


def accept(
    it: FrameNumbering, sequence: int, *, boot_id: int = 1, gate: int | None = None
) -> tuple[int, Gap | None] | None:
    gate = sequence if gate is None else gate
    accepted = it.accept(boot_id, sequence, gate * GATE_TICKS, at(gate))
    return accepted and (accepted.index, accepted.gap)


@pytest.fixture
def it() -> FrameNumbering:
    """Return a numbering that has accepted frame 0."""
    it = numbering()
    accept(it, 0)
    return it


def test_frames_that_never_came_are_a_link_gap(it: FrameNumbering) -> None:
    assert accept(it, 4) == (4, Gap(1, FrameLoss(link_gap=3)))


def test_discarded_bytes_determine_how_many_came_damaged(it: FrameNumbering) -> None:
    it.discarded(2 * FRAME_BYTES)
    assert accept(it, 4) == (4, Gap(1, FrameLoss(damaged=2, link_gap=1)))
    it.discarded(100)  # part of a frame
    assert accept(it, 6) == (6, Gap(5, FrameLoss(damaged=1)))
    it.discarded(50)  # no frame is missing: it was something else
    assert accept(it, 7) == (7, None)
    assert accept(it, 9) == (9, Gap(8, FrameLoss(link_gap=1)))


def test_what_the_board_dropped_is_its_own_cause_and_counted_once(it: FrameNumbering) -> None:
    it.dropped_by_board(5)
    assert accept(it, 6) == (6, Gap(1, FrameLoss(board_overflow=5)))
    it.dropped_by_board(5)
    assert accept(it, 9) == (9, Gap(7, FrameLoss(link_gap=2)))
    it.dropped_by_board(6)
    assert accept(it, 12) == (12, Gap(10, FrameLoss(board_overflow=1, link_gap=1)))


def test_a_report_after_a_lost_one_corrects_the_causes_of_the_earlier_gap(it: FrameNumbering) -> None:
    it.discarded(30)  # the board's report
    assert accept(it, 5) == (5, Gap(1, FrameLoss(link_gap=3, damaged=1)))
    it.dropped_by_board(6)  # 4 before, and 2 now
    corrected = FrameLoss(link_gap=-3, damaged=-1, board_overflow=6)
    assert accept(it, 8) == (8, Gap(6, corrected))
    in_outage = FrameLoss(link_gap=3, damaged=1)
    assert in_outage.within(in_outage + corrected) == FrameLoss(board_overflow=4)
    assert accept(it, 11) == (11, Gap(9, FrameLoss(link_gap=2)))
    it.dropped_by_board(7)
    assert accept(it, 12) == (12, Gap(12, FrameLoss(link_gap=-1, board_overflow=1)))
    assert accept(it, 13) == (13, None)


def test_unexplained_losses_are_in_the_snapshot() -> None:
    it, later = numbering(), numbering()
    accept(it, 0)
    accept(it, 4)
    later.restore(it.snapshot())
    later.dropped_by_board(3)
    assert accept(later, 5) == (5, Gap(5, FrameLoss(link_gap=-3, board_overflow=3)))


def test_what_the_hosts_driver_lost_is_a_cause_of_its_own(it: FrameNumbering) -> None:
    it.overrun()
    it.discarded(300)  # the fragments at both ends of what was lost
    it.dropped_by_board(1)
    assert accept(it, 6) == (6, Gap(1, FrameLoss(board_overflow=1, host_overrun=4)))
    assert accept(it, 8) == (8, Gap(7, FrameLoss(link_gap=1)))


def test_the_number_wraps_and_the_index_does_not() -> None:
    it = numbering()
    it.restore(NumberingSnapshot(2**32 - 1, 2**32 - 1, 0, (1, (2**32 - 2) * GATE_TICKS, at(2**32 - 2))))
    assert accept(it, 2**32 - 1) == (2**32 - 1, None)
    assert accept(it, 2, gate=2**32 + 2) == (2**32 + 2, Gap(2**32, FrameLoss(link_gap=2)))


def test_frames_follow_until_one_is_missing_and_not_while_a_loss_is_to_be_counted(it: FrameNumbering) -> None:
    frames = [Frame(number, number * GATE_TICKS, FRAME_BYTES, b"") for number in (1, 2, 4)]
    assert [it.count_following(frames, start) for start in range(3)] == [2, 0, 0]
    it.discarded(10)
    assert it.count_following(frames, 0) == 0
    accept(it, 1)
    assert it.count_following(frames, 1) == 1
    it.accept_following(1, 2 * GATE_TICKS, at(2))
    assert accept(it, 4) == (4, Gap(3, FrameLoss(link_gap=1)))


def test_a_frame_that_was_there_already_is_ignored(it: FrameNumbering) -> None:
    accept(it, 1)
    assert accept(it, 1) is None
    assert accept(it, 2) == (2, None)


def test_an_outage_is_a_gap_and_no_shift_of_time(it: FrameNumbering) -> None:
    it.started(0)
    assert accept(it, 0, gate=500) == (500, Gap(1, FrameLoss(link_gap=499)))
    assert accept(it, 1, gate=501) == (501, None)


def test_after_a_reboot_the_hosts_clock_determines_the_outage() -> None:
    it = numbering()
    it.accept(1, 0, 10**12, at(0))
    it.started(0)
    again = at(700.08, utc_step_ns=3_600 * 10**9)
    assert it.accept(2, 0, GATE_TICKS, again) == Accepted(700, again, Gap(1, FrameLoss(link_gap=699)), at(0))


def test_a_boot_id_that_came_twice_does_not_make_the_ticks_go_on() -> None:
    it = numbering()
    it.accept(1, 0, 10**12, at(0))
    it.started(0)
    assert not it.continues(1, GATE_TICKS)
    assert it.continues(1, 10**12 + 1)
    assert not it.continues(2, 10**12 + 1)
    assert it.accept(1, 0, GATE_TICKS, at(700)) == Accepted(700, at(700), Gap(1, FrameLoss(link_gap=699)), at(0))


@pytest.mark.parametrize(("boot_id", "ticks"), [(1, 3_600_100 * GATE_TICKS), (2, 17)], ids=["same boot", "rebooted"])
def test_a_host_that_slept_knows_how_long(it: FrameNumbering, boot_id: int, ticks: int) -> None:
    it.started(0)
    slept_ns = 3_600_000 * GATE_NS
    # The monotonic clock stood still, UTC was set meanwhile.
    awake = Instant(0, 100, 100 * GATE_NS, 100 * GATE_NS + slept_ns)
    assert it.accept(boot_id, 0, ticks, awake).index == 3_600_100


def test_frames_that_lie_otherwise_than_their_numbers_state_are_reported(it: FrameNumbering) -> None:
    with pytest.raises(BrokenSpacingError) as first:
        it.accept(1, 1, 2 * GATE_TICKS, at(1))
    assert (first.value.spacing_ticks, first.value.gate_ticks, first.value.from_the_start) == (2000, 1000, True)
    accept(it, 1)
    with pytest.raises(BrokenSpacingError) as later:
        it.accept(1, 2, 2 * GATE_TICKS + 1, at(2))
    assert not later.value.from_the_start


def test_a_first_number_that_a_run_cannot_have_reached_is_no_loss() -> None:
    it = numbering()
    it.started(0)
    for sequence in (2**31 - 5001, 30_002):
        assert it.accept(1, sequence, GATE_TICKS, at(1)) is None
    assert it.accept(1, 30_001, GATE_TICKS, at(1)) is not None  # a queue may have dropped 30 s
