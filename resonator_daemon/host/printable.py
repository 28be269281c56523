"""What boards, brokers, processes and files say, as it may go to a terminal."""


def printable(said: object) -> str:
    """Return the text in one line, without what moves a terminal's cursor or changes its look."""
    return "".join(sign if sign.isprintable() else "\N{REPLACEMENT CHARACTER}" for sign in str(said))
