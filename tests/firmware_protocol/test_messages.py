"""Field lists: absent fields and texts; the vectors have round trips and what is malformed."""

from dataclasses import replace

import pytest

from firmware_protocol.messages import (
    BoardLog,
    BoardStatus,
    Description,
    Identity,
    ResetCause,
    decode_message,
    encode_message,
)


def test_fields_that_may_be_absent_have_the_meanings_of_the_page() -> None:
    identity = decode_message(Identity, bytes((1, 0, 2, 0, 3, 0, 4, 1, 0)))
    assert (identity.credit_bytes, identity.reset_cause) == (64, ResetCause.UNKNOWN)
    required = b"".join(bytes((tag, 1, 1)) for tag in range(1, 7)) + bytes((7, 0))
    description = decode_message(Description, required)
    assert description == Description(1, 1, 1, 1, 1, 1, "", 0, 0, None, 0, 1)
    assert [replace(description, counter_kind=kind).oscillators for kind in (0, 1)] == [0, 1]
    assert encode_message(description) == required + bytes((8, 1, 0, 9, 1, 0, 11, 1, 0, 12, 1, 1))  # no queue_bytes
    assert decode_message(BoardStatus, bytes((1, 1, 0))) == BoardStatus(0, None, None)


def test_long_text_is_cut_at_a_character() -> None:
    decoded = decode_message(BoardLog, encode_message(BoardLog(30, "é" * 200)))
    assert decoded.text == "é" * 127


@pytest.mark.parametrize("sign", ["\n", "\r", "\0", "\x1b", "\x7f", "\x9b", "\u2028", "\u202e"])
def test_no_text_of_a_board_steers_a_terminal_or_begins_a_line(sign: str) -> None:
    said = decode_message(BoardLog, encode_message(BoardLog(20, f"fine{sign}INFO link online")))
    assert said.text == "fine\N{REPLACEMENT CHARACTER}INFO link online"
