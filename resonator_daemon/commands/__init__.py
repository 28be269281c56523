"""The command line: a module for each command of `resonatord`, a package for each group of commands.

A module with the name of its command has

- its help as the docstring: a summary of one line, then paragraphs, the last of which is shown below the options;
- `add_arguments(parser)`;
- `run(arguments)`, which returns the exit code.

`resonatord --help` imports all of them, so that they import what they run inside `run`. Names that begin with an
underscore are no commands. A package adds the commands of extensions in the group of entry points that it names.
"""

import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:  # every import here is time in which Ctrl-C gives a traceback
    from collections.abc import Sequence

ENTRY_POINTS = "commands"
_UNTIL_STOPPED = ("bridge", "decode", "emulate", "run", "view", "watch")  # commands for which that is the regular end
running = ""  # the command, as soon as its arguments are parsed


def main(words: "Sequence[str] | None" = None) -> int:
    """Run one command; return its exit code.

    Without `words`, SIGINT and SIGTERM end the process at once, with the command's exit code. If the command has to
    clean up, it sets handlers of its own. KeyboardInterrupt could be lost while modules are imported.
    """
    import signal

    numbers = [signal.SIGINT, signal.SIGTERM] if words is None else []
    words = sys.argv[1:] if words is None else words
    numbers = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    for number in numbers:
        signal.signal(number, lambda *_: os._exit(_interrupted(words)))
    try:
        from resonator_daemon.commands._command_line import run_command

        return run_command(words)
    finally:
        for number in numbers:  # nothing is left to do, and the exit code is known
            signal.signal(number, signal.SIG_IGN)


def _interrupted(words: "Sequence[str]") -> int:
    """Print that the command was interrupted; return the exit code."""
    if words[:1] and words[0] in _UNTIL_STOPPED:
        return 0
    error = '"error": {"code": "interrupted", "message": "interrupted", "hint": ""}'
    try:
        if "--json" in words:
            verb = running or words[0]
            os.write(1, f'{{"verb": "{verb}", {error}, "ok": false}}\n'.encode())
        os.write(2, b"resonatord: interrupted\n")
    except OSError:  # the reader has closed the pipe
        pass
    return 1
