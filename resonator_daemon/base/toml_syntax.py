"""Text that is no TOML, or too much: limits (the parser takes quadratic time for dotted keys), and remedies."""

import re
from typing import Final, NamedTuple

# The largest plate, of 46 872 tones at as many sites, has 235 000 keys, 660 000 other values, 420 000 lines.
MAX_DEPTH: Final = 8  # keys of configurations and plates have 4 at most
MAX_NESTED: Final = 32  # brackets in brackets: values of configurations and plates have 3 at most
MAX_KEYS: Final = 300_000
MAX_VALUES: Final = 1_000_000
MAX_LINES: Final = 500_000  # of headers, which take longest: 4 s

LONGEST_WORD: Final = 1000  # a bare name or a number: the parser takes 100 bytes for each of its digits

_SHOWN: Final = 40
_NAME: Final = r"""(?:[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\[^\n])*+"|'[^'\n]*+')"""
_JOINED: Final = rf"{_NAME}(?:[ \t]*+\.[ \t]*+{_NAME})"
_NUMBER: Final = r"[0-9+-][0-9_]*+(?:\.[0-9eE_+-]*+)?"
_TOKEN: Final = re.compile(
    rf"""
      "{{3}} (?: [^"\\] | \\. | "(?!"") )*+ "{{0,5}}  # text of several lines, which two more quotes may end
    | '{{3}} (?: [^'] | '(?!'') )*+ '{{0,5}}
    | \#[^\n]*+
    | (?P<word> (?<![A-Za-z0-9_+-]) [A-Za-z0-9_+-]{{{LONGEST_WORD + 1}}} )
    | (?P<dotted> (?<![A-Za-z0-9_.+-]) (?! {_NUMBER}[ \t]*+[],\r\n\#}}] ) {_JOINED}++ )
    | "(?:[^"\\\n]|\\[^\n])*+"?
    | '[^'\n]*+'?
    | (?P<opening> [\[{{] )
    | (?P<closing> [\]}}] )
    """,
    re.DOTALL | re.MULTILINE | re.VERBOSE,
)
_PART: Final = re.compile(_NAME)


class Excess(NamedTuple):
    """Breach of a limit."""

    line: int | None  # where it is in one place
    sentence: str  # with the remedy


def excess(text: str) -> Excess | None:
    """Return the first breach of a limit; costs a tenth of the parser's time.

    Signs in comments and texts count, too, where only their number is looked at.
    """
    for what, count, limit in (
        ("lines", text.count("\n"), MAX_LINES),
        ("keys", text.count("="), MAX_KEYS),
        ("values", sum(text.count(sign) for sign in ",[{"), MAX_VALUES),
    ):
        if count > limit:
            return Excess(None, f"about {count} {what}, and {limit} are read at most; name a file of settings")
    nested = 0
    for token in _TOKEN.finditer(text):
        sentence = None
        if token.lastgroup == "closing":
            nested = max(nested - 1, 0)
        elif token.lastgroup == "opening":
            nested += 1
            if nested > MAX_NESTED:
                sentence = f"more than {MAX_NESTED} brackets within each other; close them, or nest fewer"
        elif token.lastgroup == "word":
            sentence = f"{_shown(token[0])}: {LONGEST_WORD} signs of a name or number are read at most; correct it"
        elif token.lastgroup == "dotted" and (depth := len(_PART.findall(token[0]))) > MAX_DEPTH:
            sentence = f"{_shown(token[0])}: {depth} names joined by dots, and {MAX_DEPTH} are read at most; correct it"
        if sentence is not None:
            return Excess(text.count("\n", 0, token.start()) + 1, sentence)
    return None


def _shown(token: str) -> str:
    start = token.strip()[:_SHOWN]
    return f"{start if start.isprintable() else ascii(start)}..."


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
