"""The command line: a module for each command of `resonatord`, a package for each group of commands.

A module with the name of its command has

- its help as the docstring: a summary of one line, then paragraphs, the last of which is shown below the options;
- `add_arguments(parser)`;
- `run(arguments)`, which returns the exit code.

`resonatord --help` imports all of them, so that they import what they run inside `run`. Names that begin with an
underscore are no commands.
"""

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:  # every import here is time in which Ctrl-C gives a traceback
    from collections.abc import Sequence

_UNTIL_STOPPED = ("bridge", "decode", "emulate", "run", "view", "watch")  # commands for which that is the regular end


def main(words: "Sequence[str] | None" = None) -> int:
    """Run one command; return its exit code."""
    own_process, words = words is None, sys.argv[1:] if words is None else words
    try:
        if own_process:  # SIGTERM as Ctrl-C, until a command that runs for long has handlers of its own
            import signal

            signal.signal(signal.SIGTERM, signal.default_int_handler)
        from resonator_daemon.commands._command_line import run_command

        return run_command(words)
    except KeyboardInterrupt:  # while the command is loaded
        if words[:1] and words[0] in _UNTIL_STOPPED:
            return 0
        if "--json" in words:
            error = '"error": {"code": "interrupted", "message": "interrupted", "hint": ""}'
            sys.stdout.write(f'{{"verb": "{words[0]}", {error}, "ok": false}}\n')
        sys.stderr.write("resonatord: interrupted\n")
        return 1
