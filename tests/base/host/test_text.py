import pytest

from resonator_daemon.base.host.text import printable


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("Grüße, 5 µN", "Grüße, 5 µN"),
        ("a\nb\tc", "a\ufffdb\ufffdc"),
        ("\x1b[2J\x07", "\ufffd[2J\ufffd"),
        ("left\u202eright", "left\ufffdright"),
        ("half \udcff", "half \ufffd"),
        (7, "7"),
    ],
)
def test_nothing_steers_a_terminal(said: object, shown: str) -> None:
    assert printable(said) == shown
    assert printable(said).isprintable()
