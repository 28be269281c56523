"""Install systemd units, udev rules, the service user and shell completion.

Example: sudo /opt/resonatord/bin/resonatord install
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.base.host.text import print_note, with_pages
from resonator_daemon.tools.command_line import finish

if TYPE_CHECKING:
    from resonator_daemon.base.host.install import Installation

SHARE: Final = "/usr/local/share"
COMPLETION_FILES: Final = {
    "bash": f"{SHARE}/bash-completion/completions/resonatord",
    "zsh": f"{SHARE}/zsh/site-functions/_resonatord",
    "fish": f"{SHARE}/fish/vendor_completions.d/resonatord.fish",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dry-run", action="store_true", help="print what would be done, and do nothing")
    parser.add_argument("--prefix", type=Path, metavar="DIR", help="work below it, and run nothing: for an image")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    """Print what was done; InstallError where a step failed."""
    from resonator_daemon.base.host.install import EXAMPLE, InstallError, install, uninstall
    from resonator_daemon.board.config import example_config

    verb, prefix, dry_run = arguments.command, arguments.prefix, arguments.dry_run
    made_here = {EXAMPLE: with_pages(example_config()), **dict(completions())}
    done = (install if verb == "install" else uninstall)(prefix, made_here, dry_run=dry_run)
    result = {
        "program": str(done.program),
        "warning": done.warning,
        "dry_run": dry_run,
        "files": [{"path": str(file.path), "action": file.action} for file in done.placed],
        "commands": [
            {"command": " ".join(command), "done": done.run and error is None, "error": error}
            for command, error in done.commands
        ],
    }
    if not arguments.json:
        if done.warning:
            print_note(f"warning: {done.warning}")
        sys.stdout.writelines(f"{line}\n" for line in _lines(verb, done))
        if verb == "install" and prefix is None and not done.warning:
            sys.stdout.write(
                f"next: copy {EXAMPLE} to /etc/resonatord/NAME.toml, then: systemctl enable --now resonatord@NAME\n"
            )
    if failed := [f"{' '.join(command)}: {error}" for command, error in done.commands if error]:
        raise InstallError(*failed, partial_result=result)
    return finish(arguments, result)


def _lines(verb: str, done: "Installation") -> Iterator[str]:
    from resonator_daemon.base.host.install import Action

    elsewhere = "; `resonatord install --prefix DIR` writes the new one elsewhere" if verb == "install" else ""
    more = {
        Action.READ_ONLY: "left out: this file system is read-only",
        Action.KEPT: f"kept: it was changed here{elsewhere}",
    }
    for file in done.placed:
        yield f"{file.path}: {more.get(file.action) or file.action.replace('_', ' ')}"
    for command, error in done.commands:
        yield f"{' '.join(command)}: {error or ('done' if done.run else 'would be run')}"


def completions() -> Iterator[tuple[str, str]]:
    """Yield path and text of the completion script of each shell."""
    import shtab

    from resonator_daemon.commands._command_line import make_parser, parsers

    root = make_parser()
    for _, parser in parsers(root):
        parser.description = (parser.description or "").partition(". ")[0]  # next to each command in the shell
        for action in parser._actions:  # noqa: SLF001 - argparse has no other way to list arguments
            if "--plate" in action.option_strings and action.choices is None:
                action.complete = _plates_and_files()  # type: ignore[attr-defined]
            elif (kind := _kind(action)) is not None:
                action.complete = getattr(shtab, kind)  # type: ignore[attr-defined]
    for shell, path in COMPLETION_FILES.items():
        yield path, shtab.complete(root, shell)


def _plates_and_files() -> dict[str, object]:
    """Return the completion of plate names and files for each shell."""
    from resonator_daemon.base.plate import shipped_plates

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
