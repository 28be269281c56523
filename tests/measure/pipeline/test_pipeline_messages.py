"""Messages made from readings: names, times and numbers against hand-worked ones, in the words of the wire."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plates import plate_head, site
from report_makers import LOST, NAN, Losses, Messages, configured, gate_middle, literal

from firmware_protocol.messages import Configuration, Description, Identity
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.frames import BoardOnline, LinkChange
from resonator_daemon.estimate.forces.readings import (
    Compensation,
    Contact,
    ContactEvent,
    ForceReading,
    SensorStatus,
    Touch,
)
from resonator_daemon.estimate.forces.site_identification import SiteForce
from resonator_daemon.mqtt.payloads import Condition, Lost

# Ids that are no indices, and ticks that are no nanoseconds.
FORCE_PLATE = plate_head("three", (0, 0), (20, 10), reference_hz=250e6, frame_rate_hz=1000) + "".join(
    site(number, *position_mm, force=(f0_hz, -6.3e-6))
    for number, position_mm, f0_hz in ((70, (6, 4), 9.996e6), (30, (12.5, 4), 9.992e6), (12, (3, 8), 9.988e6))
)

WHY = Reason(ReasonCode.CHANNELS_SILENT, "why")
GATE_MIDDLE = gate_middle(1_000_000)
COUNTS = Reason(ReasonCode.BOARD_COUNTS, "")
GONE = Reason(ReasonCode.UNPLUGGED, "unplugged")
ONLINE = LinkChange(Condition.ONLINE, COUNTS, 1, 1)
UNPLUGGED = LinkChange(Condition.LOST, GONE, 1_788_999_990_000_000_001, 1_788_999_990_000_000_002)


@pytest.fixture
def messages(tmp_path: Path) -> Messages:
    """For the plate with the sites 70, 30 and 12."""
    return Messages(configured(tmp_path, FORCE_PLATE))


def reading(
    status: SensorStatus = "ok",
    *,
    sites: tuple[SiteForce, ...] = (),
    contacts: tuple[Contact, ...] = (),
    window_s: float = 0.01,
    board_ticks: int = 2_000_000_000,
) -> ForceReading:
    compensation = Compensation((1e-6, NAN, 0.0, -1e-6), 2e-7, "held", 1.5, NAN, "off")
    return ForceReading(99, board_ticks, window_s, True, status, WHY, sites, contacts, (), compensation, (2,))


def contact(
    site: int = 1,
    force_newton: float = 1.234,
    status: str = "ok",
    *,
    number: int = 12,
    since_ticks: int = 1_625_000_000,
) -> Contact:
    """Set on 1.5 s before the reading at 250 MHz, if not told otherwise."""
    known = status == "ok"
    touch = Touch(
        site,
        (0.0125, 0.004),
        np.array([[4e-8, 3e-8], [3e-8, 9e-8]]),
        force_newton,
        0.0006 if known else NAN,
        0.012 if known else NAN,
        status,
        Reason(ReasonCode.OTHER_SITE, "another is heard"),
    )
    return Contact(number, touch, 1.5, since_ticks, 125_000_000)


def test_forces_are_the_contracts_literal(messages: Messages) -> None:
    """Their time is 5 ms before the end of a window of 10 ms."""
    message = messages.force.forces(
        reading(sites=(SiteForce(1, 1.234, 0.0006, 0.012, "ok", unobserved_bound_newton=6.17),)), GATE_MIDDLE
    )
    assert literal(message) == json.loads(Path(__file__).with_name("forces.json").read_text())


def test_contacts_are_the_contracts_literal(messages: Messages) -> None:
    said = literal(messages.force.contacts(reading(contacts=(contact(), contact(2, number=13))), GATE_MIDDLE))
    first, second = said["contacts"]
    assert first == CONTACT
    assert (second["id"], second["site"]) == (13, 12)


CONTACT = {
    "id": 12, "site": 30, "position_m": [0.0125, 0.004], "position_covariance_m2": [4e-8, 3e-8, 9e-8],
    "force_newton": [None, None, 1.234], "noise_newton": [None, None, 0.0006],
    "systematic_newton": [None, None, 0.012], "status": "ok", "reason_code": "other_site"
}  # fmt: skip
HISTORY = {
    "peak_newton": 1.5,
    "since_t_ns": "1788999998495000123",  # 1.5 s of ticks before the middle of the window
    "duration_s": 0.5,
}


def test_a_contact_keeps_its_date(messages: Messages) -> None:
    """The board's nominal rate is off: over an hour its ticks and UTC go apart by milliseconds."""
    since = set()
    for event, later_s in (("onset", 0), ("release", 3600)):
        later = reading(board_ticks=2_000_000_000 + later_s * 250_001_000)
        at = gate_middle(1_000_000, later_ns=later_s * 1_000_000_000)
        since.add(messages.force.event(ContactEvent(event, 1, contact(), None), later, at).contact.since_t_ns)
    assert len(since) == 1


@pytest.mark.parametrize("word", ["onset", "release"])
def test_an_event_reports_its_own_contact_with_its_peak(messages: Messages, word: Any) -> None:
    gone = contact(0, NAN, "no_signal", number=3)
    present = reading(contacts=(contact(),))
    said = literal(messages.force.event(ContactEvent(word, 1_999_000_000, gone, WHY), present, GATE_MIDDLE))
    assert (said["event"], said["reason_code"], said["reason"]) == (word, "channels_silent", "why")
    assert said["board_ticks"] == "2000000000"  # of the reading that told it, as its time
    unknown = {key: [None, None, None] for key in ("force_newton", "noise_newton", "systematic_newton")}
    assert said["contact"] == CONTACT | HISTORY | unknown | {"id": 3, "site": 70, "status": "no_signal"}


def test_losses_and_the_boards_boot_are_those_of_the_moment(tmp_path: Path) -> None:
    losses = Losses()
    messages = Messages(configured(tmp_path, FORCE_PLATE), losses)
    messages.headers.board_boot_id = None
    first = literal(messages.states.sensor_state(Condition.WAITING, WHY, 1, 1, None))
    assert first["board_boot_id"] is None
    losses.now = Lost(damaged=8)
    messages.headers.board_boot_id = "51ab"
    second = literal(messages.states.sensor_state(Condition.ONLINE, WHY, 1, 1, None))
    assert (first["lost"], second["lost"], literal(messages.force.forces(reading(), GATE_MIDDLE))["lost"]) == (
        LOST,
        {"damaged": 8},
        {"damaged": 8},
    )
    assert second["board_boot_id"] == "51ab"


BOARD = BoardOnline(
    Identity("quartz board", "0042", "1.2.3", 0),
    Description(0, 4, 1, 10**12, 1, 1, "three"),
    1,
    Configuration(1),
    continues=False,
)


@pytest.mark.parametrize(("expiry", "status"), [("2020-01-01", "uncalibrated"), ("9999-12-31", "ok")])
def test_forces_of_an_expired_calibration_are_marked(tmp_path: Path, expiry: str, status: str) -> None:
    plate = FORCE_PLATE + f'[calibration]\nid = "c1"\ndate = 2019-01-01\nexpiry = {expiry}\n'
    messages = Messages(configured(tmp_path, plate))
    measured = reading(sites=(SiteForce(1, 1.2, 0.1, 0.1, "ok"),), contacts=(contact(),))
    assert literal(messages.force.forces(measured, GATE_MIDDLE))["sites"][0]["status"] == status
    assert literal(messages.force.contacts(measured, GATE_MIDDLE))["contacts"][0]["status"] == status
    said = literal(messages.states.info(BOARD, 1))["calibration"]
    assert (said["id"], said["date"], said["expiry"], said["response"]) == ("c1", "2019-01-01", expiry, "off")


def test_info_needs_no_file(messages: Messages, monkeypatch: pytest.MonkeyPatch) -> None:
    """An upgrade replaces the installed files, and descriptors may run out, while a board comes back."""
    running = literal(messages.states.info(BOARD, 1))["daemon_version"]
    monkeypatch.setattr("importlib.metadata.Distribution.from_name", lambda name: pytest.fail(f"{name} is read"))
    assert literal(messages.states.info(BOARD, 1))["daemon_version"] == running


def test_decimated_topics_have_their_rates_in_info(tmp_path: Path) -> None:
    said = literal(Messages(configured(tmp_path, FORCE_PLATE)).states.info(BOARD, 1))["rates_hz"]
    assert said == {"forces": 200.0, "forces/20hz": 20.0, "contacts": 200.0, "contacts/20hz": 20.0, "tones": 20.0}


def test_a_skin_that_is_decoded_elsewhere_has_its_signals_alone(tmp_path: Path) -> None:
    messages = Messages(configured(tmp_path, "skin32", decoding={"external": True}))
    assert [topic.path for topic in messages.sensor.streams] == ["signals"]
    assert set(literal(messages.states.info(BOARD, 1))["rates_hz"]) == {"signals", "signals/5hz"}


def test_states_never_go_back_in_time(messages: Messages) -> None:
    """Frames show that the link is back: the middle of their gate lies before the moment that showed their absence."""
    waiting = messages.states.sensor_state(Condition.WAITING, WHY, 2_000, 2_000, None)
    online = messages.states.sensor_state(Condition.ONLINE, WHY, 1_500, 1_600, None)
    later = messages.states.sensor_state(Condition.DRIFTING, WHY, 1_900, 2_100, None)
    link = messages.states.link_state(LinkChange(Condition.ONLINE, COUNTS, 1_000, 1_000), None, 1)
    assert [(state.t_ns, state.since_t_ns) for state in (waiting, online, later, link)] == [
        (2_000, 2_000),
        (2_000, 2_000),
        (2_100, 2_000),
        (1_000, 1_000),
    ]


def test_suspect_sites_are_in_the_state_that_names_them(tmp_path: Path) -> None:
    decoding = SimpleNamespace(suspects=(3, 7))
    states = Messages(configured(tmp_path, "skin32"), make_decoding=lambda *_: decoding).states
    suspect = Reason(ReasonCode.SENSOR_SUSPECT, "sites 3, 7")
    named, other = (literal(states.sensor_state(Condition.ONLINE, why, 1, 1, None)) for why in (suspect, WHY))
    assert named["suspect_sites"] == [3, 7]
    assert "suspect_sites" not in other
