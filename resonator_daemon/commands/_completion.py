"""Completion of the command line in bash, zsh and fish, made from its parser."""

import argparse
from collections.abc import Iterator

from resonator_daemon.commands._command_line import make_parser, parsers
from resonator_daemon.plate import shipped_plates

SHARE = "/usr/local/share"
PLACES = {
    "bash": f"{SHARE}/bash-completion/completions/resonatord",
    "zsh": f"{SHARE}/zsh/site-functions/_resonatord",
    "fish": f"{SHARE}/fish/vendor_completions.d/resonatord.fish",
}


def completions() -> Iterator[tuple[str, str]]:
    """Yield place and text of the completion script of each shell."""
    import shtab

    root = make_parser()
    for _, parser in parsers(root):
        parser.description = (parser.description or "").partition(". ")[0]  # next to each command in the shell
        for action in parser._actions:  # noqa: SLF001 - argparse has no other way to list arguments
            if "--plate" in action.option_strings and action.choices is None:
                action.complete = _plates_and_files()  # type: ignore[attr-defined]
            elif (kind := _kind(action)) is not None:
                action.complete = getattr(shtab, kind)  # type: ignore[attr-defined]
    for shell, place in PLACES.items():
        yield place, shtab.complete(root, shell)


def _plates_and_files() -> dict[str, object]:
    """Return what completes the name of a shipped plate, or a file, for each shell."""
    names, function = " ".join(shipped_plates()), "_resonatord_plate_files"  # bash quotes names of _file functions
    return {
        "bash": function,
        "zsh": function,
        "fish": f"{names} (__fish_complete_path (commandline -ct))",
        "preamble": {
            "bash": f'{function}() {{ compgen -W "{names}" -- "$1"; compgen -f -- "$1"; }}',
            "zsh": f"{function}() {{ compadd {names}; _files; }}",
        },
    }


def _kind(action: argparse.Action) -> str | None:
    name = action.metavar if isinstance(action.metavar, str) else ""
    if "DIR" in name:
        return "DIRECTORY"
    return "FILE" if "FILE" in name or name in ("OUT", "LINKPATH") else None
