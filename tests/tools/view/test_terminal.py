"""What the page shows of plates."""

import io
import math
import re

import pytest
from rich.console import Console
from view_messages import (
    NOW_NS,
    S,
    contact,
    contacts,
    contacts_of,
    forces,
    health,
    info,
    onset,
    site_force,
    state,
    summary,
)

from resonator_daemon.mqtt.payloads import Lost, Message
from resonator_daemon.tools.view.plate_view import PlateView
from resonator_daemon.tools.view.terminal import Truth, render
from resonator_daemon.tools.view.words import losses_in_words

SITES = {7: (-0.0005, 0.002), 13: (0.007, 0.0066)}
PRESSED = contact(7, 1.0, (0.433, 0.25), id=3, slip_margin=0.416, slip_margin_std=0.023)


def quartz16(*messages: tuple[str, Message]) -> PlateView:
    view = PlateView("thumb")
    online = [(f"state/{name}", state("online")) for name in ("daemon", "link", "sensor")]
    for path, message in [*online, ("info", info(SITES)), ("health", health()), *messages]:
        view.add(path, message, NOW_NS)
    return view


def page(
    *views: PlateView,
    truth: Truth = (),
    at_ns: int = NOW_NS,
    width: int = 100,
    height: int = 40,
) -> str:
    console = Console(width=width, height=height, file=io.StringIO())
    console.print(render(views, {view.name: truth for view in views}, at_ns, title="a page"))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert len(text.splitlines()) <= height
    return text


def words(text: str) -> str:
    return " ".join(text.split())


def skin32(*messages: tuple[str, Message]) -> PlateView:
    default = (
        ("decoded/summary", summary()),
        ("contacts", contacts_of(PRESSED)),
    )
    return quartz16(*(messages or default))


def test_a_contact_is_a_row_and_the_truth_another() -> None:
    view = quartz16(
        ("forces", forces(site_force(7, 1.2))),
        ("contacts", contacts(7, 1.23412)),
        ("contacts/event", onset(7, since_s_ago=0.42)),
    )
    truth = ({"site": 7, "position_m": SITES[7], "force_newton": [0.1, 0.0, 0.2]},)
    measured, true = page(view, truth=truth).splitlines()[4:6]
    assert words(measured).endswith("7 0.00, 0.00 1.234 N ± 0.6 ± 12 mN - - 0.4 s")
    assert words(true) == "true 7 -0.50, 2.00 200.0 mN 100.0 mN at 0°"
    measured, *_ = page(skin32()).splitlines()[4:]
    assert words(measured).startswith("3 7 ")
    assert words(measured).endswith("1.000 N ± 0.6 ± 12 mN 500.0 mN at 30° 0.42 ± 0.02 0.0 s")


def test_no_number_is_cut_in_a_narrow_terminal() -> None:
    truth = ({"site": 13, "position_m": SITES[13], "force_newton": [0.1, 0.0, 0.2]},)

    def numbers(width: int) -> list[str]:
        text = page(skin32(), truth=truth, width=width, height=60)
        assert max(map(len, text.splitlines())) <= width
        return sorted(re.findall(r"[-+]?\d[\d.]*", text))

    assert {"1.000", "500.0", "0.42", "7.00", "127.0.0.1", "5555"} <= set(numbers(200))
    for width in range(24, 100):
        assert numbers(width) == numbers(200)


def test_a_force_that_is_unknown_is_no_number() -> None:
    beyond = contact(7, math.nan, status="overload", at_least_newton=10.0)
    unknown = contact(13, math.nan, status="ambiguous")
    text = words(page(quartz16(("contacts", contacts_of(beyond, unknown)))))
    assert "at least 10.000 N (overload)" in text
    assert "- (ambiguous)" in text
    assert "nan" not in text


def test_the_largest_forces_of_the_last_30_s_are_a_graph_as_high_as_there_is_room() -> None:
    view = quartz16()
    for seconds, newton in ((-40, 9.0), (-20, 0.5), (-10, 2.0), (0, 1.0)):
        view.add("contacts", contacts(7, newton), NOW_NS + seconds * S)
    *_, top, _, _, _, middle, _, _, bottom = page(view, width=70).splitlines()
    assert (top[:10], bottom[:10]) == ("  2.000 N ", "    -30 s ")
    assert (top.count("█"), middle.count("█"), bottom.count("█")) == (1, 2, 3)
    assert bottom[10:].index("█") == 19
    assert "█" not in page(view, height=9)


def test_losses_have_a_rate() -> None:
    view = quartz16()
    view.add("health", health().model_copy(update={"lost": Lost(link_gap=40)}), NOW_NS + 8 * S)
    assert "frames lost: link gap 40 (5.0/s)" in words(page(view, at_ns=NOW_NS + 8 * S))


def test_nothing_touched_is_distinguished_from_nothing_known() -> None:
    none = ("contacts", contacts_of())
    assert "no contact" in page(quartz16(("forces", forces()), none))
    pressed = page(quartz16(("forces", forces(status="pressed_at_start")), none))
    assert ("no contact" in pressed, "status pressed_at_start" in pressed) == (False, True)
    never = page(quartz16())
    assert ("no contact" in never, "nothing measured arrives" in never) == (False, True)


def test_what_is_old_is_not_shown_as_present() -> None:
    for view in (quartz16(("forces", forces(site_force(7, 1.234))), ("contacts", contacts(7, 1.234))), skin32()):
        text = words(page(view, at_ns=NOW_NS + 10 * S))
        assert "1.234" not in text
        assert "nothing measured arrives" in text
        assert text.count("unknown (was online)") == 3


def test_states_come_with_reason_and_duration_unless_online() -> None:
    lost = ("state/link", state("lost", "[Errno 5] it was unplugged", since_s_ago=72))
    waiting = ("state/sensor", state("waiting", "link lost: [Errno 5] it was unplugged", since_s_ago=3))
    text = words(page(quartz16(lost, waiting)))
    assert "daemon online link lost for 1 min 12 s: [Errno 5] it was unplugged sensor waiting for 3.0 s: link" in text
    text = words(page(quartz16(("state/sensor", state("drifting", "0.3 ppm/s", since_s_ago=7200)))))
    assert "sensor drifting for 2 h 0 min: 0.3 ppm/s" in text
    busy = state("online", "the computer is busy").model_copy(update={"reason_code": "computer_busy"})
    assert "link online for 10.0 s: the computer is busy" in words(page(quartz16(("state/link", busy))))


@pytest.mark.parametrize(("width", "height"), [(100, 40), (80, 24), (200, 60)])
def test_two_plates_fit_the_terminal(width: int, height: int) -> None:
    views = quartz16(("contacts", contacts(7, 1.0))), skin32()
    lines = page(*views, width=width, height=height).splitlines()
    assert (max(map(len, lines)) <= width, len(lines) <= height) == (True, True)


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ({"link_gap": 0, "skipped_late": 0}, "nothing lost"),
        ({"link_gap": 3, "damaged": 2}, "frames lost: link gap 3, damaged 2"),
        ({"link_gap": 0, "skipped_late": 9}, "no frame lost; 9 messages skipped as late"),
    ],
)
def test_messages_that_are_left_out_are_no_lost_frames(counts: dict[str, int], words: str) -> None:
    assert losses_in_words(counts) == words
