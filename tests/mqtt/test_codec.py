"""CBOR with typed arrays against bytes written by hand from RFC 8949 and RFC 8746; damage is refused."""

import struct
from typing import Any

import numpy as np
import pytest
from example_messages import example
from mqtt_helpers import HEADER
from numpy.typing import NDArray
from pydantic_core import PydanticSerializationError

from resonator_daemon.mqtt.codec import decode, encode, encode_fields
from resonator_daemon.mqtt.payloads import Contacts, Decoded, Forces, Lost, Measured, Signals

# 40([[3, 2], 85(h'...')]): tag 40 is d8 28, array of 2 is 82, 85 is d8 55, 24 bytes are 58 18
VALUES = (0.0, 1.0, -2.0, 0.5, float("inf"), 3.0)
ARRAY = bytes.fromhex("d828 82 82 03 02 d855 58 18") + struct.pack("<6f", *VALUES)
EXPECTED = np.array([[0.0, 1.0], [-2.0, 0.5], [np.inf, 3.0]])

# the header and board_ticks of a map of 10; 1b is an 8-byte integer, 19 a 2-byte one
LOST = b"\xa1\x67damaged\x02"  # the causes that have occurred
HEAD = (
    b"\xaa\x64name\x6aleft-index\x63seq\x19\x04\xd2\x6edaemon_boot_id\x649f3c"
    + b"\x64t_ns\x1b"
    + (1789000000000000000).to_bytes(8, "big")
    + b"\x70t_uncertainty_ns\x19\xa4\x10\x64lost"
    + LOST
    + b"\x6bboard_ticks\x1b"
    + (2**63).to_bytes(8, "big")
)
NOISE = b"\x69noise_std" + ARRAY
STATUS = b"\x66status\x62ok"
SIGNALS = HEAD + NOISE + STATUS + b"\x67signals"  # keys may come in any order


def signals(array: NDArray[Any]) -> Signals:
    head = HEADER | {"lost": Lost(damaged=2)}
    return Signals(**head, board_ticks=2**63, signals=array, noise_std=array, status="ok")


def test_bytes_are_those_of_the_standards() -> None:
    assert encode(signals(EXPECTED)) == HEAD + b"\x67signals" + ARRAY + NOISE + STATUS


def test_bytes_of_the_standards_are_read() -> None:
    read = decode(Signals, SIGNALS + ARRAY)
    assert read.t_ns == 1789000000000000000
    assert read.board_ticks == 2**63
    np.testing.assert_array_equal(read.noise_std, EXPECTED)
    assert read.status == "ok"
    assert read.signals.dtype == np.float32
    np.testing.assert_array_equal(read.signals, EXPECTED)


@pytest.mark.parametrize(
    "array",
    [
        np.full((3, 4), np.nan),
        np.arange(24.0).reshape(3, 8)[:, ::2],
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.arange(12).reshape(3, 4).astype(">f4"),
        np.zeros((3, 0)),
    ],
    ids=["nan", "strided", "fortran", "big-endian", "empty"],
)
def test_any_array_comes_back_as_it_was(array: NDArray[Any]) -> None:
    read = decode(Signals, encode(signals(array)))
    np.testing.assert_array_equal(read.signals, array)
    np.testing.assert_array_equal(read.noise_std, array)


def test_arrays_of_one_message_have_one_shape() -> None:
    with pytest.raises(ValueError, match=r"traction_std_pascal has shape \(3, 2\), must be"):
        Decoded(
            **HEADER,
            board_ticks=1,
            traction_pascal=np.zeros((3, 4)),
            traction_std_pascal=np.zeros((3, 2)),
            displacement_m=None,
            grid=None,
        )


@pytest.mark.parametrize(
    ("array", "finding"),
    [
        (ARRAY + b"\x00", "1 bytes after"),
        (ARRAY[:-1], "not CBOR"),
        (b"", "not CBOR"),
        (ARRAY.replace(b"\x82\x03\x02", b"\x82\x03\x03"), "6 elements do not fill the shape"),
        (ARRAY.replace(b"\x82\x03\x02", b"\x82\x22\x21"), "6 elements do not fill the shape"),
        (ARRAY.replace(b"\x82\x03\x02", b"\x82\x03\xf5"), "6 elements do not fill the shape"),
        (ARRAY.replace(b"\x82\x03\x02", b"\x80"), "at most 3 dimensions"),
        (ARRAY.replace(b"\x82\x03\x02", b"\x84\x03\x02\x01\x01"), "at most 3 dimensions"),
        (bytes.fromhex("d828 82 82 03 00 d855 43 000000"), "multiple of 4"),
        (bytes.fromhex("d828 82 82 03 00 d855 60"), "byte string"),
        (bytes.fromhex("d828 82 82 03 00 80"), "float32 elements"),
        (bytes.fromhex("d828 03"), "float32 elements"),
        (bytes.fromhex("d855 44 00000000"), "must be an array"),
        (bytes.fromhex("83 81 00 81 00 81 00"), "must be an array"),
        (bytes.fromhex("a0"), "must be an array"),
        (bytes.fromhex("f6"), "must be an array"),
        (b"\x81" * 10_000 + b"\x00", "not CBOR"),
        (bytes.fromhex("5b 7fffffffffffffff"), "not CBOR"),
    ],
)
def test_damaged_arrays_are_refused(array: bytes, finding: str) -> None:
    with pytest.raises(ValueError, match=finding):
        decode(Signals, SIGNALS + array)


@pytest.mark.parametrize("kind", [Forces, Contacts])
def test_fields_are_encoded_as_their_model_is(kind: type[Measured]) -> None:
    message = example(kind)
    encoded = encode_fields(kind, message.model_dump())
    assert (encoded.payload, encoded.t_ns) == (message.model_dump_json().encode(), message.t_ns)


@pytest.mark.parametrize(("field", "value"), [("status", 1), ("lost", 3), ("sites", "none")])
def test_fields_of_another_type_are_no_message(field: str, value: object) -> None:
    with pytest.raises(PydanticSerializationError):
        encode_fields(Forces, example(Forces).model_dump() | {field: value})
