"""JSON from strangers: one meaning or none."""

import re

import pytest

from resonator_daemon.mqtt.commands import NESTING_MAX, PAYLOAD_BYTES_MAX, read_object


@pytest.mark.parametrize(
    ("data", "content"),
    [
        (b"{}", {}),
        (b' {"a": [1, -2.5e3, null, true, "\xc3\xa9"]}\n', {"a": [1, -2500.0, None, True, "é"]}),
        (b'{"a": {"a": 1}}', {"a": {"a": 1}}),
        (b'{"a": 18446744073709551615}', {"a": 2**64 - 1}),
    ],
)
def test_sound_objects_are_read(data: bytes, content: dict[str, object]) -> None:
    assert read_object(data) == content


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"\xff\x00", "is not UTF-8: byte 0xff at 0"),
        ("{}".encode("utf-16"), "is not UTF-8"),
        ("{}".encode("utf-8-sig"), "is not JSON"),
        (b"\x00", "is not JSON"),
        (b"[1]", "is JSON, but not an object"),
        (b"{", "is not JSON: Expecting property name enclosed in double quotes at 1"),
        (b"{}{}", "is not JSON: Extra data at 2"),
        (b"{'a': 1}", "is not JSON"),
        (b'{"a": 1, "a": 1}', 'key "a" is there twice'),
        (b'{"b": {"a": 1, "a": 2}}', 'key "a" is there twice'),
        (b'{"a": NaN}', "NaN is no JSON"),
        (b'{"a": -Infinity}', "-Infinity is no JSON"),
        (b'{"a": 1e999}', "1e999 is more than a double holds"),
        (b'{"a": ' + b"1" * 21 + b"}", "an integer of 21 digits, at most 20"),
        (b'{"a": ' + b"1" * 10_000 + b"}", "an integer of 10000 digits, at most 20"),
        (b"[" * 10_000, f"nested more than {NESTING_MAX} deep"),
        (b'{"a": ' + b"[" * NESTING_MAX + b"]" * NESTING_MAX + b"}", f"nested more than {NESTING_MAX} deep"),
        (b"{}" + b" " * PAYLOAD_BYTES_MAX, f"payload of {PAYLOAD_BYTES_MAX + 2} bytes, at most {PAYLOAD_BYTES_MAX}"),
    ],
)
def test_all_else_is_refused_in_one_short_sentence(data: bytes, sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)) as refused:
        read_object(data)
    assert len(str(refused.value)) < 200


def test_bounds_are_within() -> None:
    read_object(b"{}" + b" " * (PAYLOAD_BYTES_MAX - 2))
    inner = NESTING_MAX - 1
    read_object(b'{"a": ' + b"[" * inner + b"]" * inner + b"}")
