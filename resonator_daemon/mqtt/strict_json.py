"""Strict reader of JSON objects from unknown senders: what parsers may read in more than one way is refused."""

import json
import math
from typing import Any, Final, NoReturn

PAYLOAD_BYTES_MAX: Final = 16 * 1024
NESTING_MAX: Final = 8
DIGITS_MAX: Final = 20  # of a 64 bit integer


def read_object(data: bytes) -> dict[str, Any]:
    """Read the object in UTF-8.

    Raises
    ------
    ValueError
        Empty, too long, not JSON, not an object, nested too deep, a key twice, or a number that no double or 64 bits
        hold.
    """
    if len(data) > PAYLOAD_BYTES_MAX:
        raise ValueError(f"payload of {len(data)} bytes, at most {PAYLOAD_BYTES_MAX}")
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"the payload is not UTF-8: byte 0x{data[error.start]:02x} at {error.start}") from None
    if not text:
        raise ValueError("the payload is empty")
    try:
        content = _DECODER.decode(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"the payload is not JSON: {error.msg} at {error.pos}") from None
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    if not isinstance(content, dict):
        raise ValueError("the payload is JSON, but not an object")
    _check_nesting(content)
    return content


_TOO_DEEP: Final = f"the payload is nested more than {NESTING_MAX} deep"


def _check_nesting(content: object) -> None:
    level = [content]
    for _ in range(NESTING_MAX + 1):
        containers = [item for item in level if isinstance(item, dict | list)]
        if not containers:
            return
        level = [value for each in containers for value in (each.values() if isinstance(each, dict) else each)]
    raise ValueError(_TOO_DEEP)


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"key {json.dumps(key)[:80]} is there twice")
        content[key] = value
    return content


def _integer(digits: str) -> int:
    if len(digits) > DIGITS_MAX:
        raise ValueError(f"an integer of {len(digits)} digits, at most {DIGITS_MAX}")
    return int(digits)


def _finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(f"{digits[:20]} is more than a double holds")
    return number


def _no_number(word: str) -> NoReturn:
    raise ValueError(f"{word} is no JSON")


_DECODER: Final = json.JSONDecoder(
    object_pairs_hook=_each_key_once, parse_int=_integer, parse_float=_finite, parse_constant=_no_number
)
