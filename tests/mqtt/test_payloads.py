"""Payloads: closed sets of words, unknown numbers, 64-bit integers; docs/reference has an example of each."""

import json
import math

import numpy as np
import pytest
from example_messages import example
from hypothesis import given
from hypothesis import strategies as st
from sample_messages import HEADER

from resonator_daemon.mqtt.codec import decode, encode
from resonator_daemon.mqtt.message_examples import EXAMPLES
from resonator_daemon.mqtt.payloads import Forces, SiteForce, State

FORCE = {"force_newton": 1.234, "noise_newton": 0.0006, "systematic_newton": 0.012, "status": "ok"}


def test_keys_that_a_reader_does_not_know_are_ignored() -> None:
    payload = json.dumps({"added_later": [1], **EXAMPLES["Forces"]}).encode()
    assert json.loads(encode(decode(Forces, payload))) == EXAMPLES["Forces"]


@pytest.mark.parametrize("unknown", [math.nan, math.inf, -math.inf, np.float64("nan")])
def test_what_is_not_known_is_null_in_json_and_nan_when_read(unknown: float) -> None:
    site = SiteForce(site=7, **FORCE | dict.fromkeys(FORCE, unknown) | {"status": "overload", "at_least_newton": 10.0})
    message = example(Forces, sites=(site,))
    encoded = encode(message)
    assert b'"force_newton":null' in encoded
    json.loads(encoded, parse_constant=pytest.fail)  # called for NaN and Infinity
    (read,) = decode(Forces, encoded).sites
    assert math.isnan(read.force_newton)
    assert math.isnan(read.noise_newton)
    assert read.at_least_newton == 10.0


@given(st.integers(0, 2**64 - 1))
def test_64_bit_integers_are_exact(number: int) -> None:
    message = State(**HEADER | {"t_ns": number}, state="online", reason="", since_t_ns=number)
    as_doubles = json.loads(encode(message), parse_int=float)
    assert as_doubles["t_ns"] == as_doubles["since_t_ns"] == str(number)
    assert decode(State, encode(message)) == message


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b'{"seq": 1}', b"\xff\xfe", b"null"])
def test_json_that_is_no_message_is_refused(payload: bytes) -> None:
    with pytest.raises(ValueError, match="Forces"):
        decode(Forces, payload)
