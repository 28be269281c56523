"""The daemon's reader, unchanged, against the board program: from identifying to reconnecting."""

from itertools import pairwise

import pytest
from firmware_listener import FirmwareListener
from switch import Switch

pytestmark = pytest.mark.firmware

GATE_TICKS = 1_000_000


def test_frames_are_in_order_and_their_ticks_even(switch: Switch) -> None:
    with FirmwareListener(switch.link) as it:
        it.wait_for_more_frames(1500)
        account = it.reader.counters()
        it.check_accounts()
    assert it.boards[0].identity.serial_number == "FW-0001"
    assert account.bytes_discarded == 0
    assert account.lost.total == account.lost.board_overflow  # none on a machine that is fast enough for QEMU
    for earlier, later in pairwise(it.frames):
        assert later.board_ticks - earlier.board_ticks == (later.index - earlier.index) * GATE_TICKS


def test_a_board_that_is_switched_off_and_on_is_another_boot_and_an_outage(switch: Switch) -> None:
    with FirmwareListener(switch.link) as it:
        it.wait_for_more_frames(300)
        switch.board.power_off()
        it.wait_for(lambda _: it.states[-1][0] not in ("online", "stalled"))
        seen = len(it.frames)
        switch.board.power_on()
        it.wait_for_more_frames(300)
        it.check_accounts()
        account = it.reader.counters()
    first, second = it.boards
    assert first.boot_id != second.boot_id
    assert first.identity == second.identity
    before, after = it.frames[seen - 1], it.frames[seen]
    gates_away = after.index - before.index - 1
    assert account.lost.link_gap >= gates_away > 0
    # The gap has the length that the clocks tell, to what they may be off in the first moments.
    away_ns = after.gate_middle.utc_ns - before.gate_middle.utc_ns
    slack_ns = before.gate_middle.uncertainty_ns + after.gate_middle.uncertainty_ns + 1_000_000
    assert abs(away_ns - (gates_away + 1) * 1_000_000) <= slack_ns


def test_a_reset_in_the_middle_of_a_run_is_noticed_by_its_boot_id(switch: Switch) -> None:
    with FirmwareListener(switch.link) as it:
        it.wait_for_more_frames(300)
        switch.board.reset()
        it.wait_for(lambda _: len(it.boards) == 2)
        it.wait_for_more_frames(300)
        it.check_accounts()
    first, second = it.boards
    assert first.boot_id != second.boot_id
    assert (first.identity.reset_cause, second.identity.reset_cause) == (1, 5)


@pytest.mark.parametrize("switch", ["tcp"], indirect=True)
def test_a_second_daemon_after_the_first(switch: Switch) -> None:
    """The board was left running or told to stop: either way the next host begins with frame 0."""
    with FirmwareListener(switch.link) as first:
        first.wait_for_more_frames(100)
    with FirmwareListener(switch.link) as second:
        second.wait_for_more_frames(100)
        second.check_accounts()
        assert second.reader.counters().lost.link_gap == 0
    assert first.boards[0].boot_id == second.boards[0].boot_id
    assert second.frames[0].board_ticks > first.frames[-1].board_ticks
