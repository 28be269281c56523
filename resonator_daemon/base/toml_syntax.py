"""Remedies for text that is no TOML."""

import re
from typing import Final

_FIRST_WORD = re.compile(r"[\s\[\"']*([A-Za-z0-9_.-]{1,60})")
_ONE_A_LINE: Final = "one key = value a line; a number stands alone, without a unit or leading zeros"
_TYPOGRAPHIC_QUOTES: Final = "\u201c\u201d\u201e\u2018\u2019\u00ab\u00bb"
_TRUTHS: Final = frozenset({"true", "false", "yes", "no", "on", "off"})
_OF_REASONS: Final = (
    (("overwrite", "twice", "mutate", "redefine", "Duplicate"), "each key and each table may be there once"),
    (("Unclosed", "Expected ']'", "Unterminated array"), "close with ] or } what was opened"),
    (("backslash", "'\\\\'", "Unescaped", "hex value"), "write \\\\ for a backslash, or put text in 'single quotes'"),
    (
        ("Illegal character '\\n'", "Illegal character '\\r'", "Unterminated string"),
        "close the quotes on the same line",
    ),
    (("Illegal character",), "remove that character"),
)


def advice(line: str, column: int, reason: str) -> str:
    """Return the remedy, with the line's key if it has one; empty if no remedy is known.

    Parameters
    ----------
    line
        At which the parser gave up; empty at the end of the file.
    column
        Where on that line, from 1.
    reason
        Message of the parser.
    """
    key = _FIRST_WORD.match(line)
    remedy = _remedy(line.strip(), line[column - 1 :].strip(), reason)
    return "; ".join(filter(None, (f"at {key[1]}" if key else "", remedy)))


def _remedy(line: str, rest: str, reason: str) -> str | None:
    if any(quote in line for quote in _TYPOGRAPHIC_QUOTES):
        return 'use plain " quotes'
    for words, remedy in _OF_REASONS:
        if any(word in reason for word in words):
            return remedy
    if line.startswith(("//", ";", "--", "%", "/*")):
        return "comments begin with #"
    if "Invalid value" in reason:
        if not rest or rest.startswith("#"):
            return "give a value after ="
        if re.split(r"\W", rest)[0].lower() in _TRUTHS:
            return "write true or false, in small letters, without quotes"
        return 'put text in quotes, as "text"'
    if "Expected newline" in reason:
        return "write a decimal point, not a comma" if rest.startswith(",") else _ONE_A_LINE
    if "Expected '='" in reason or "Invalid statement" in reason:
        return "write key = value, [table] or # comment"
    return None
