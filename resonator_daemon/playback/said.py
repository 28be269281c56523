"""What recordings say, as it may go to a terminal."""


def printable(text: str) -> str:
    """Return the text with a sign in place of each that no terminal should get."""
    return "".join(sign if sign.isprintable() else "\N{REPLACEMENT CHARACTER}" for sign in text)
