"""Closed sets of words, each with its meaning; the states of daemon, link, sensor and decoder."""

from enum import StrEnum
from typing import Any, Self

from pydantic import GetJsonSchemaHandler
from pydantic_core import CoreSchema


class Word(StrEnum):
    """A word of a closed set, with what it means."""

    meaning: str

    def __new__(cls, word: str, meaning: str = "") -> Self:  # a look-up by word gives no meaning
        member = str.__new__(cls, word)
        member._value_ = word
        member.meaning = meaning
        return member

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        plain = handler.resolve_ref_schema(handler(schema))
        about = [plain["description"], *(f"- `{word}`: {word.meaning}" for word in cls)]
        plain["description"] = "\n".join(about)
        plain["x-enum-varnames"] = [word.name for word in cls]
        plain["x-enum-descriptions"] = [word.meaning for word in cls]
        return plain


class Condition(Word):
    """The words of the states of daemon, link, sensor and decoder."""

    OFFLINE = "offline", "not running: stopped, or ended without notice (last will)"
    STARTING = "starting", "on the way to online; nothing is wrong yet"
    ONLINE = "online", "working"
    WAITING = "waiting", "what it needs (port, board, network, frames) is not there; tried again for ever"
    STALLED = "stalled", "the link is open and nothing usable comes; of a skin also: its decoder ended"
    LOST = "lost", "was there and went away; tried again for ever"
    DRIFTING = "drifting", "the baseline moves faster than touches and temperature explain"
    PRESSED_AT_START = "pressed_at_start", "touched before the untouched plate was known; release it"
    UNCALIBRATED = "uncalibrated", "the calibration has expired"
    REFUSED = "refused", "the board or the plate file can never serve this configuration"
