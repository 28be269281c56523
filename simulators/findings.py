"""Error messages for invalid values of a scenario or of a list of faults."""

import re
from collections.abc import Sequence
from difflib import get_close_matches

from pydantic_core import ErrorDetails

_NUMBER_WITH_UNIT = re.compile(r"\s*([-+]?[0-9][0-9_.]*(?:[eE][-+]?[0-9]+)?)\s*[A-Za-zµ/%]*\s*")


def message_of(error: ErrorDetails) -> str:
    """Return what was given and what must be, in a line that the key comes before."""
    value = error["input"]
    got = f"got {'a table' if isinstance(value, dict) else repr(value)}; "
    match error["type"]:
        case "missing":
            return "missing; give a value"
        case "value_error":
            return f"{'' if isinstance(value, dict) else got}{error['ctx']['error']}"
        case "literal_error" if isinstance(value, str):
            allowed = error["ctx"]["expected"].replace("'", "").replace(" or ", ", ").split(", ")
            return f"{got}{nearest(value, allowed)}"
        case "float_type" | "int_type" if isinstance(value, str) and (alone := _NUMBER_WITH_UNIT.fullmatch(value)):
            return f"{got}must be a number: give it alone, as {alone[1]}; the key names its unit"
        case "bool_type":
            return f"{got}must be true or false, without quotes"
        case "tuple_type":
            return f"{got}must be a list"
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"{got}must be a table of keys"
        case _:
            return got + re.sub(r"^(Input|String|List|Tuple) should (be|have|match)", r"must \2", error["msg"])


def nearest(word: str, allowed: Sequence[str]) -> str:
    """Return the end of a message about a word that is none of those allowed."""
    near = get_close_matches(word, allowed, n=1)
    return f"did you mean {near[0]}?" if near else f"allowed: {', '.join(allowed)}"
