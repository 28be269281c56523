"""Foreign text made safe for terminals."""


def printable(text: object) -> str:
    """Return the text in one line, without control characters."""
    return "".join(sign if sign.isprintable() else "\N{REPLACEMENT CHARACTER}" for sign in str(text))
