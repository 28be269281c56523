"""Payloads against the literal examples of the interface, written out by hand, never by the code under test."""

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from resonator_daemon.publishing.codec import decode, encode
from resonator_daemon.publishing.payloads import (
    Compensation,
    Condition,
    Contact,
    ContactEvent,
    Contacts,
    DecodedSummary,
    EventContact,
    Forces,
    Lost,
    Message,
    OutageInfo,
    Patch,
    SiteForce,
    State,
    Status,
)

MEASURED: dict[str, Any] = {
    "seq": 1234,
    "daemon_boot_id": "9f3c",
    "board_boot_id": "51aa",
    "t_ns": 1789000000000000000,
    "t_unc_ns": 42000,
    "lost": Lost(
        link_gap=1, damaged=2, board_overflow=3, host_overrun=4, ring_overflow=6, publish_dropped=5, skipped_late=7
    ),
    "board_ticks": 123456789,
}
HEADER = {key: value for key, value in MEASURED.items() if key != "board_ticks"}
HEADER_JSON = """
    "seq": 1234, "daemon_boot_id": "9f3c", "board_boot_id": "51aa", "t_ns": "1789000000000000000", "t_unc_ns": 42000,
    "lost": {"link_gap": 1, "damaged": 2, "board_overflow": 3, "host_overrun": 4, "ring_overflow": 6,
        "publish_dropped": 5, "skipped_late": 7}
"""
OUTAGE = OutageInfo(start_t_ns=1788999998000000000, end_t_ns=1788999999000000000, frames_lost=999, reason="?")
FORCE = {"force_newton": 1.234, "noise_newton": 0.0006, "systematic_newton": 0.012, "status": "ok"}
CONTACT: dict[str, Any] = {
    "id": 12,
    "site": 7,
    "position_m": (0.0012, -0.0034),
    "position_std_m": (2e-4, 2e-4),
    "position_correlation": -0.25,
    "hidden_newton": 0.05,
    "peak_newton": 1.3,
    "since_t_ns": 1788999999000000000,
    "duration_s": 0.35,
    **FORCE,
}
CONTACT_JSON = """
    "id": 12, "site": 7, "position_m": [0.0012, -0.0034], "position_std_m": [2e-4, 2e-4],
    "position_correlation": -0.25, "force_newton": 1.234, "noise_newton": 0.0006, "systematic_newton": 0.012,
    "hidden_newton": 0.05, "peak_newton": 1.3, "since_t_ns": "1788999999000000000", "duration_s": 0.35, "status": "ok",
    "reason": "", "at_least_newton": null
"""
COMPENSATION = Compensation(
    baseline="held",
    common_mode=(3e-6, math.nan, 3.5e-6, -2e-6),
    common_mode_std=2e-7,
    plate_kelvin=math.nan,
    plate_kelvin_std=math.nan,
    response="off",
)
PATCH: dict[str, Any] = {
    "id": 3,
    "centroid_m": (0.001, -0.002),
    "centroid_std_m": (1e-5, 2e-5),
    "area_m2": 1.9e-5,
    "force_newton": (0.1, -0.2, 1.5),
    "force_std_newton": (0.003, 0.004, 0.005),
    "moment_newton_m": (1e-3, 2e-3, 3e-5),
    "moment_std_newton_m": (1e-6, 2e-6, 3e-6),
    "at_border": True,
    "radius_of_curvature_m": 0.0056,
    "stick_ratio": 0.5,
    "slip_margin": 0.125,
    "slip_margin_std": 0.01,
    "friction_coefficient": 0.6,
    "friction_coefficient_std": 0.03,
    "slip_reason": "",
}

EXAMPLES = [
    (
        Forces(
            **MEASURED,
            window_s=0.01,
            status="possibly_more",
            reason="more than the counted tone is heard",
            sites=(SiteForce(site=7, **FORCE),),
            beats=(0, 2),
            compensation=COMPENSATION,
        ),
        """{<header>, "board_ticks": "123456789", "window_s": 0.01, "status": "possibly_more",
           "reason": "more than the counted tone is heard", "sites": [{"site": 7,
           "force_newton": 1.234, "noise_newton": 0.0006, "systematic_newton": 0.012, "hidden_newton": 0.0,
           "status": "ok", "at_least_newton": null}], "beats": [0, 2], "compensation": {"baseline": "held",
           "common_mode": [3e-6, null, 3.5e-6, -2e-6], "common_mode_std": 2e-7, "plate_kelvin": null,
           "plate_kelvin_std": null, "response": "off"}}""",
    ),
    (
        Contacts(**MEASURED, status="ok", contacts=(Contact(**CONTACT),)),
        """{<header>, "board_ticks": "123456789", "status": "ok", "reason": "", "contacts": [{<contact>}],
            "decoder_id": null}""",
    ),
    (
        ContactEvent(**MEASURED, event="release", reason="no longer felt", contact=EventContact(**CONTACT)),
        """{<header>, "board_ticks": "123456789", "event": "release", "reason": "no longer felt", "contact": {<contact>,
             "slip_margin": null, "slip_margin_std": null, "friction_coefficient": null},
             "decoder_id": null, "replayed": false}""",
    ),
    (
        DecodedSummary(
            **MEASURED,
            decoder="open-plane+contact",
            chi2=1.02,
            border_contact=False,
            status="ok",
            reason="3 signals lost",
            patches=(Patch(**PATCH),),
        ),
        """{<header>, "board_ticks": "123456789", "decoder": "open-plane+contact", "chi2": 1.02,
           "border_contact": false, "status": "ok", "reason": "3 signals lost", "patches": [{
             "id": 3, "centroid_m": [0.001, -0.002], "centroid_std_m": [1e-5, 2e-5], "area_m2": 1.9e-5,
             "force_newton": [0.1, -0.2, 1.5], "force_std_newton": [0.003, 0.004, 0.005],
             "moment_newton_m": [1e-3, 2e-3, 3e-5], "moment_std_newton_m": [1e-6, 2e-6, 3e-6], "at_border": true,
             "radius_of_curvature_m": 0.0056, "stick_ratio": 0.5, "slip_margin": 0.125, "slip_margin_std": 0.01,
             "friction_coefficient": 0.6, "friction_coefficient_std": 0.03,
             "slip_reason": ""}], "decoder_id": null}""",
    ),
    (
        State(
            **HEADER,
            state="online",
            reason="back",
            since_t_ns=1788999999000000000,
            last_outage=OutageInfo(
                start_t_ns=1788999998000000000, end_t_ns=1788999999000000000, frames_lost=999, reason="?"
            ),
            boots=3,
            connections=2,
            connected_t_ns=1788999997000000000,
        ),
        """{<header>, "state": "online", "reason": "back", "since_t_ns": "1788999999000000000", "last_outage":
        {"start_t_ns": "1788999998000000000", "end_t_ns": "1788999999000000000", "frames_lost": 999, "reason": "?"},
        "boots": 3, "connections": 2, "connected_t_ns": "1788999997000000000"}""",
    ),
    (
        State(**HEADER | {"board_boot_id": None}, state="offline", reason="connection lost", since_t_ns=None),
        """{<header of no board>, "state": "offline", "reason": "connection lost", "since_t_ns": null,
        "last_outage": null, "boots": null, "connections": null, "connected_t_ns": null}""",
    ),
]


def written_out(literal: str) -> str:
    no_board = HEADER_JSON.replace('"51aa"', "null")
    with_header = literal.replace("<header>", HEADER_JSON).replace("<header of no board>", no_board)
    return with_header.replace("<contact>", CONTACT_JSON)


@pytest.mark.parametrize(("message", "literal"), EXAMPLES, ids=lambda value: type(value).__name__)
def test_json_is_that_of_the_interface(message: Message, literal: str) -> None:
    literal = written_out(literal)
    assert json.loads(encode(message)) == json.loads(literal)
    assert decode(type(message), literal.encode()) == message


def test_readers_pass_over_keys_they_do_not_know() -> None:
    literal = written_out(EXAMPLES[0][1]).replace('"window_s"', '"added_later": [1], "window_s"')
    assert decode(Forces, literal.encode()) == EXAMPLES[0][0]


def test_the_status_values_of_the_interface_are_served() -> None:
    assert set(Status) >= {
        *("ok", "constraint_dropped", "ambiguous", "rejected", "possibly_more", "overload"),
        *("no_signal", "pilot_lost", "uncalibrated", "pressed_at_start"),
    }


def test_the_states_of_the_interface_are_served() -> None:
    assert set(Condition) >= {
        *("online", "offline", "starting", "waiting", "stalled", "lost", "drifting", "pressed_at_start"),
    }


@pytest.mark.parametrize("word", ["fine", "OK", ""])
def test_words_outside_the_closed_sets_are_refused(word: str) -> None:
    with pytest.raises(ValueError, match="status"):
        SiteForce(site=7, **FORCE | {"status": word})
    with pytest.raises(ValueError, match="state"):
        State(**HEADER, state=word, reason="", since_t_ns=0)


@pytest.mark.parametrize("unknown", [math.nan, math.inf, -math.inf, np.float64("nan")])
def test_what_is_not_known_is_null_in_json_and_nan_when_read(unknown: float) -> None:
    site = SiteForce(
        site=7,
        force_newton=unknown,
        noise_newton=unknown,
        systematic_newton=unknown,
        status="overload",
        at_least_newton=10.0,
    )
    message = Forces(
        **MEASURED, window_s=0.01, status="ok", reason="", sites=(site,), beats=(), compensation=COMPENSATION
    )
    encoded = encode(message)
    assert b'"force_newton":null' in encoded
    json.loads(encoded, parse_constant=pytest.fail)  # called for NaN and Infinity
    (read,) = decode(Forces, encoded).sites
    assert math.isnan(read.force_newton)
    assert math.isnan(read.noise_newton)
    assert read.at_least_newton == 10.0


def test_what_no_fit_tells_of_a_patch_is_null() -> None:
    of_the_fit = ("radius_of_curvature_m", "stick_ratio", "slip_margin", "slip_margin_std", "friction_coefficient")
    patch = Patch(**PATCH | dict.fromkeys(of_the_fit, math.nan) | {"moment_std_newton_m": (math.nan, 0.0, math.inf)})
    encoded = encode(patch)
    said = json.loads(encoded, parse_constant=pytest.fail)
    assert [said[key] for key in of_the_fit] == [None] * 5
    assert said["moment_std_newton_m"] == [None, 0.0, None]
    read = decode(Patch, encoded)
    assert all(math.isnan(getattr(read, key)) for key in of_the_fit)


@given(st.integers(0, 2**64 - 1))
def test_64_bit_integers_are_exact(number: int) -> None:
    message = State(**HEADER | {"t_ns": number}, state="online", reason="", since_t_ns=number)
    as_doubles = json.loads(encode(message), parse_int=float)
    assert as_doubles["t_ns"] == as_doubles["since_t_ns"] == str(number)
    assert decode(State, encode(message)) == message


@pytest.mark.parametrize("number", [-1, 2**64])
def test_numbers_beyond_64_bits_are_refused(number: int) -> None:
    with pytest.raises(ValueError, match="t_ns"):
        State(**HEADER | {"t_ns": number}, state="online", reason="", since_t_ns=0)


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b'{"seq": 1}', b"\xff\xfe", b"null"])
def test_json_that_is_no_message_is_refused(payload: bytes) -> None:
    with pytest.raises(ValueError, match="Forces"):
        decode(Forces, payload)
