"""The command line: a module for each command of `resonatord`, a package for each group of commands.

A module with the name of its command has

- its help as the docstring: a summary of one line, then paragraphs, the last of which is shown below the options;
- `add_arguments(parser)`;
- `run(arguments)`, which returns the exit code.

`resonatord --help` imports all of them, so that they import what they run inside `run`. Names that begin with an
underscore are no commands.
"""

import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:  # every import here is time in which Ctrl-C gives a traceback
    from collections.abc import Callable, Sequence

_UNTIL_STOPPED = ("bridge", "decode", "emulate", "run", "view", "watch")  # commands for which that is the regular end


def main(words: "Sequence[str] | None" = None) -> int:
    """Run one command; return its exit code."""
    own_process, words = words is None, sys.argv[1:] if words is None else words
    try:
        loaded = _end_on_signals(words) if own_process else lambda: None
        from resonator_daemon.commands._command_line import run_command

        return run_command(words, loaded)
    except KeyboardInterrupt:  # before there is a handler
        return _interrupted(words)


def _end_on_signals(words: "Sequence[str]") -> "Callable[[], None]":
    """Let SIGINT and SIGTERM end the process at once, until the function that is returned is called.

    KeyboardInterrupt inside a library that is being loaded can get lost there, or become another error.
    """
    import signal

    numbers = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) is not signal.SIG_IGN]
    for number in numbers:
        signal.signal(number, lambda *_: os._exit(_interrupted(words)))

    def loaded() -> None:
        for number in numbers:  # SIGTERM as Ctrl-C, until a command that runs for long has handlers of its own
            signal.signal(number, signal.default_int_handler)

    return loaded


def _interrupted(words: "Sequence[str]") -> int:
    """Print that the command was interrupted while it was loaded; return the exit code."""
    if words[:1] and words[0] in _UNTIL_STOPPED:
        return 0
    error = '"error": {"code": "interrupted", "message": "interrupted", "hint": ""}'
    try:
        if "--json" in words:
            os.write(1, f'{{"verb": "{words[0]}", {error}, "ok": false}}\n'.encode())
        os.write(2, b"resonatord: interrupted\n")
    except OSError:  # a reader that has left
        pass
    return 1
