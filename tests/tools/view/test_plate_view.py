"""What a view keeps of one plate: the last messages, rates, and nothing of an earlier run."""

import math

import pytest
from view_messages import NOW_NS, S, forces, info, state

from resonator_daemon.mqtt.payloads import Lost
from resonator_daemon.mqtt.topics import FORCES, INFO, STATE_DAEMON, STATE_LINK
from resonator_daemon.tools.view.plate_view import PlateView


@pytest.fixture
def view() -> PlateView:
    return PlateView("left")


def link_state(view: PlateView) -> str | None:
    message = view.last(STATE_LINK)
    return None if message is None else message.state


def test_rate_is_that_of_the_stream_also_by_its_decimated_copies(view: PlateView) -> None:
    view.add("forces", forces(seq=0), NOW_NS)
    assert math.isnan(view.rate_hz(FORCES, NOW_NS))
    for number in range(1, 40):  # every tenth of 200/s
        view.add("forces", forces(seq=10 * number), NOW_NS + number * S // 20)
    assert view.rate_hz(FORCES, NOW_NS + 2 * S) == pytest.approx(200)
    assert math.isnan(view.rate_hz(FORCES, NOW_NS + 3 * S))
    assert view.age_s(NOW_NS + 4 * S) == pytest.approx(2.05)


def test_losses_never_go_back_to_those_of_a_last_will(view: PlateView) -> None:
    view.add("forces", forces(lost=Lost(link_gap=4)), NOW_NS)
    view.add("state/daemon", state("offline", lost=Lost(link_gap=1)), NOW_NS)
    assert view.lost == Lost(link_gap=4)


def test_a_new_run_starts_with_nothing(view: PlateView) -> None:
    view.add("info", info({7: (0.0, 0.0)}), NOW_NS)
    view.add("forces", forces(seq=1, lost=Lost(damaged=3)), NOW_NS)
    view.add("forces", forces(seq=5), NOW_NS)
    view.add("forces", forces(seq=90, daemon_boot_id="new", t_ns=NOW_NS - 3600 * S), NOW_NS)
    assert view.last(INFO) is None
    assert view.lost == Lost()


def test_retained_messages_of_an_earlier_run_do_not_hide_the_present_one(view: PlateView) -> None:
    now = {"daemon_boot_id": "new", "t_ns": NOW_NS + S}
    view.add("state/daemon", state("online", **now), NOW_NS)
    view.add("info", info({7: (0.0, 0.0)}), NOW_NS)
    view.add("state/link", state("waiting", **now), NOW_NS)
    assert view.last(INFO) is None
    assert link_state(view) == "waiting"
    assert view.last(STATE_DAEMON) is not None


def test_retained_messages_of_a_run_whose_clock_is_behind_are_found_once_it_measures(view: PlateView) -> None:
    behind = {"daemon_boot_id": "new", "t_ns": NOW_NS - 3600 * S}
    view.add("state/link", state("lost"), NOW_NS)
    view.add("state/link", state("online", **behind), NOW_NS)
    assert link_state(view) == "lost"
    view.add("forces", forces(**behind), NOW_NS)
    assert link_state(view) == "online"
