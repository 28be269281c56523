"""Messages to the page: a payload as published behind its address, and JSON objects of one key."""

import json
from typing import Any, Final

LIVE: Final = "live"  # the source that is a broker; recordings are `a` and `b`
ADDRESS_MAX: Final = 255  # bytes, which one byte counts


def payload_frame(source: str, plate: str, path: str, payload: bytes) -> bytes | None:
    """Return a binary message: one byte n, n bytes `source/plate/path`, the payload.

    None: the address is too long.
    """
    address = f"{source}/{plate}/{path}".encode()
    if len(address) > ADDRESS_MAX:
        return None
    return b"".join((bytes((len(address),)), address, payload))


def text_frame(key: str, content: Any) -> str:
    """Return a text message: a JSON object with one key."""
    return json.dumps({key: content}, separators=(",", ":"))


def refusal(number: int | str | None, code: str, message: str) -> str:
    """Return the answer to a request that was not carried out."""
    return text_frame("answer", {"id": number, "ok": False, "error": {"code": code, "message": message}})
