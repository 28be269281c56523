"""The command line, in the test's own process."""

from resonator_daemon.commands import main


def exit_code(*words: object) -> int:
    """Run a command; return its exit code, also where the parser exits."""
    try:
        return main([str(word) for word in words])
    except SystemExit as ended:
        return int(ended.code or 0)
