"""What the page says of plates, at several sizes, with colours and without."""

import io
import math

import numpy as np
import pytest
from rich.console import Console
from view_messages import (
    NOW_NS,
    S,
    contacts,
    contacts_of_skin,
    decoded,
    forces,
    health,
    info,
    onset,
    site_force,
    skin_contact,
    state,
    summary,
)

from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.tools.view.plate_view import PlateView, TrueContact, Truth
from resonator_daemon.tools.view.terminal import render, summary_line
from resonator_daemon.tools.view.words import losses_in_words

SITES = {7: (-0.0005, 0.002), 13: (0.007, 0.0066)}
PIXEL_M2 = 4e-4**2
PRESSED = skin_contact(3, (0.433, 0.25, 1.0), slip_margin=0.416, slip_margin_std=0.023)


def quartz16(*messages: tuple[str, Message]) -> PlateView:
    view = PlateView("thumb")
    online = [(f"state/{name}", state("online")) for name in ("daemon", "link", "sensor")]
    for path, message in [*online, ("info", info(SITES)), ("health", health()), *messages]:
        view.add(path, message, NOW_NS)
    return view


def page(
    *views: PlateView,
    truth: Truth | None = None,
    at_ns: int = NOW_NS,
    width: int = 100,
    height: int = 40,
    **how: object,
) -> str:
    console = Console(width=width, height=height, file=io.StringIO(), **how)  # type: ignore[arg-type]
    truths = {view.name: truth for view in views} if truth else {}
    console.print(render(views, truths, at_ns, title="a page"))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert len(text.splitlines()) <= height
    return text


def words(text: str) -> str:
    return " ".join(text.split())


def skin_tractions() -> np.ndarray:
    """1 N of pressure and 0.5 N of shear, at 30° from x, all on one pixel right of the middle and below it."""
    traction = np.zeros((3, 32, 32))
    traction[:, 24, 20] = np.array([0.5 * math.cos(math.pi / 6), 0.25, 1.0]) / PIXEL_M2
    return traction


def skin32(*messages: tuple[str, Message]) -> PlateView:
    default = (
        ("decoded", decoded(skin_tractions())),
        ("decoded/summary", summary()),
        ("contacts", contacts_of_skin(PRESSED)),
    )
    return quartz16(*(messages or default))


def test_a_touch_is_a_row_of_the_table_and_a_mark_on_the_map() -> None:
    view = quartz16(
        ("forces", forces(site_force(7, 1.23412))),
        ("contacts/event", onset(7, since_s_ago=0.42)),
        ("contacts", contacts(7, 1.2)),
    )
    text = page(view)
    row = next(line for line in text.splitlines() if "1.234 N" in line)
    assert words(row).endswith("7 1.234 N ± 0.6 ± 12 mN ok 0.4 s")
    assert "▃7" in text
    assert "status ok" in text
    assert "true" not in text


def test_true_forces_stand_beside_the_measured() -> None:
    view = quartz16(("forces", forces(site_force(7, 0.2001))))
    truth = Truth(
        contacts=(TrueContact(7, SITES[7], (0.1, 0.0, 0.2)), TrueContact(13, SITES[13], (0.0, 0.0, 10.0))),
        traction_z_pascal=None,
        latency_ms=(2.13, 7.94),
    )
    text = page(view, truth=truth)
    seven, thirteen = (words(line) for line in text.splitlines() if "ok -" in words(line) or "not measured" in line)
    assert seven.endswith("7 200.1 mN ± 0.6 ± 12 mN 200.0 mN ok -")
    assert thirteen.endswith("13 - 10.000 N not measured -")
    assert "▂7▂" in text
    assert "13█" in text
    assert "latency p50 2.1 ms" in words(text)
    assert "latency p99 7.9 ms" in words(text)


def test_an_overload_and_an_unknown_force_are_no_numbers() -> None:
    beyond = site_force(7, math.nan, status="overload", at_least_newton=10.0)
    unknown = site_force(13, math.nan, status="ambiguous", noise_newton=math.nan)
    text = words(page(quartz16(("forces", forces(beyond, unknown, status="overload", reason="beyond 10 N")))))
    assert "7 at least 10.000 N overload" in text
    assert "13 - ambiguous" in text
    assert "?7" in text
    assert "status overload (beyond 10 N)" in text
    assert "nan" not in text


def test_nothing_touched_is_distinguished_from_nothing_known() -> None:
    assert "no touch" in page(quartz16(("forces", forces())))
    pressed = page(quartz16(("forces", forces(status="pressed_at_start"))))
    assert "no touch" not in pressed
    assert "status pressed_at_start" in pressed
    never = page(quartz16())
    assert "no touch" not in never
    assert "forces unknown: none arrive" in never


def test_what_is_old_is_not_shown_as_present() -> None:
    view = quartz16(("forces", forces(site_force(7, 1.234))), ("contacts", contacts(7, 1.234)))
    text = words(page(view, at_ns=NOW_NS + 10 * S))
    assert "1.234" not in text
    assert "forces unknown: none arrive" in text
    assert "frames - forces 0/s health unknown" in text
    assert text.count("unknown (was online)") == 3
    text = words(page(skin32(), at_ns=NOW_NS + 10 * S))
    assert "surface unknown: nothing decoded arrives" in text
    assert "contacts unknown" in text


def test_states_come_with_reason_and_duration_unless_online() -> None:
    lost = ("state/link", state("lost", "[Errno 5] it was unplugged", since_s_ago=72))
    waiting = ("state/sensor", state("waiting", "link lost: [Errno 5] it was unplugged", since_s_ago=3))
    text = words(page(quartz16(lost, waiting)))
    assert "daemon online link lost for 1 min 12 s: [Errno 5] it was unplugged sensor waiting for 3.0 s ···" in text
    text = words(page(quartz16(("state/sensor", state("drifting", "0.3 ppm/s", since_s_ago=7200)))))
    assert "sensor drifting for 2 h 0 min: 0.3 ppm/s" in text
    busy = state("online", "the computer is busy").model_copy(update={"reason_code": "computer_busy"})
    assert "link online for 10.0 s: the computer is busy" in words(page(quartz16(("state/link", busy))))


def beside_the_map(text: str, columns: int = 34) -> str:
    return words(" ".join(line[columns:] for line in text.splitlines()[3:]))


def test_each_contact_is_a_column_and_the_truth_another() -> None:
    truth = Truth((TrueContact(None, (0.002, 0.003), (0.4, 0.0, 1.5)),), skin_tractions()[2], (12.1, 17.9))
    beside = beside_the_map(page(skin32(), truth=truth), columns=68)
    assert "no contact" not in summary_line(skin32(), NOW_NS)
    table = "contact 3 true normal 1.000 N 1.500 N shear 500.0 mN 400.0 mN towards 30° 0°"
    assert f"{table} margin 0.42 ± 0.02" in beside
    assert "status ok, open-plane+contact chi2 1.02, clear of the border" in beside
    two = ("contacts", contacts_of_skin(PRESSED, skin_contact(5, (0.0, -0.05, 0.2))))
    beside = beside_the_map(page(skin32(("decoded", decoded(skin_tractions())), ("decoded/summary", summary()), two)))
    assert "contact 3 5 normal 1.000 N 200.0 mN shear 500.0 mN 50.0 mN towards 30° -90°" in beside
    assert "margin 0.42 ± 0.02 - status" in beside


@pytest.mark.parametrize(("width", "height"), [(100, 40), (100, 37), (80, 24), (60, 15), (200, 60)])
@pytest.mark.parametrize("color_system", [None, "256", "truecolor"])
def test_two_plates_fit_the_terminal(width: int, height: int, color_system: str | None) -> None:
    truth = Truth((TrueContact(7, SITES[7], (0.0, 0.0, 1.0)),), skin_tractions()[2], (2.0, 3.0))
    views = quartz16(("forces", forces(site_force(7, 1.0)))), skin32()
    how = {"color_system": color_system, "force_terminal": True, "legacy_windows": False}
    text = page(*views, truth=truth, width=width, height=height, **how)
    plain = page(*views, truth=truth, width=width, height=height)
    assert max(map(len, plain.splitlines())) <= width
    assert ("\x1b[38;" in text) == (color_system is not None)


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
