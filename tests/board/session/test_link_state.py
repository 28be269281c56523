"""What is said of a link, from one state to the next."""

import pytest

from resonator_daemon.base.reasons import Condition, Reason, ReasonCode
from resonator_daemon.board.session.clock import Instant
from resonator_daemon.board.session.frames import Arrival, Outage
from resonator_daemon.board.session.link_state import LinkState

S = 1_000_000_000
BEGUN_NS = 1_789_000_000 * S
COUNTS = Reason(ReasonCode.BOARD_COUNTS, "it counts")
UNPLUGGED = Reason(ReasonCode.UNPLUGGED, "unplugged")


def lost() -> tuple[list[Arrival], LinkState]:
    """Return what was said, and the link that counted and is lost."""
    said: list[Arrival] = []
    link = LinkState(said.append)
    link.announce(Condition.ONLINE, COUNTS, BEGUN_NS)
    link.announce(Condition.LOST, UNPLUGGED, BEGUN_NS + S)
    return said, link


@pytest.mark.parametrize("set_s", [0, 7200, -7200, 1_700_000_000])
@pytest.mark.parametrize("slept_s", [0, 600])
def test_an_outage_is_as_long_as_it_was_though_the_clock_was_set_meanwhile(set_s: int, slept_s: int) -> None:
    said, link = lost()
    before = Instant(BEGUN_NS, 100, 5 * S, 5 * S)
    end_ns = BEGUN_NS + (4 + slept_s + set_s) * S
    link.frame_received(before, Instant(end_ns, 100, 9 * S, (9 + slept_s) * S), 4000)
    assert said[2:] == [Outage(end_ns - (4 + slept_s) * S, end_ns, 4000, UNPLUGGED)]


@pytest.mark.parametrize(("previous", "frames_lost"), [(Instant(BEGUN_NS, 100, 5 * S, 5 * S), 0), (None, 4000)])
def test_an_outage_without_a_loss_is_not_announced(previous: Instant | None, frames_lost: int) -> None:
    said, link = lost()
    link.frame_received(previous, Instant(BEGUN_NS + 4 * S, 100, 9 * S, 9 * S), frames_lost)
    assert len(said) == 2
    assert link.snapshot().outage_reasons == ()
