"""Put units, udev rules and user of the services, completion and manual pages into their places.

Example: sudo /opt/resonatord/bin/resonatord install
"""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from resonator_daemon.commands._output import print_error, print_json
from resonator_daemon.errors import ExitCode
from resonator_daemon.host.printable import print_note

if TYPE_CHECKING:
    from collections.abc import Iterator

    from resonator_daemon.host.install import Action, Installation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dry-run", action="store_true", help="print what would be done, and do nothing")
    parser.add_argument("--prefix", type=Path, metavar="DIR", help="write below it, and run nothing: for an image")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def run(arguments: argparse.Namespace) -> ExitCode:
    from resonator_daemon.commands._completion import completions
    from resonator_daemon.commands._manual import manual
    from resonator_daemon.config import example_config
    from resonator_daemon.host.install import EXAMPLE, install

    made = {EXAMPLE: example_config(), **dict(completions()), **dict(manual())}
    done = install(arguments.prefix, made, dry_run=arguments.dry_run)
    failed = [f"{' '.join(command)}: {error}" for command, error in done.commands if error]
    if arguments.json:
        print_json(_as_json(done, dry_run=arguments.dry_run, ok=not failed))
    else:
        _print(done, arguments.prefix)
    print_error(*failed)
    return ExitCode.FAILED if failed else ExitCode.DONE


def _print(done: "Installation", prefix: Path | None) -> None:
    from resonator_daemon.host.install import EXAMPLE, Action

    words = {
        Action.WOULD_WRITE: "would be written",
        Action.WOULD_UPDATE: "would be updated",
        Action.READ_ONLY: "left out: this file system is read-only",
        Action.KEPT: "kept: it was changed here; `resonatord install --prefix DIR` writes the new one elsewhere",
    }
    lines = [f"{place}: {words.get(action, str(action))}" for place, action in _places(done)]
    for command, error in done.commands:
        lines.append(f"{' '.join(command)}: {error or ('done' if done.run else 'would be run')}")
    if done.warning:
        print_note(f"warning: {done.warning}")
    elif prefix is None:
        lines.append(f"next: copy {EXAMPLE} to /etc/resonatord/NAME.toml, then: systemctl enable --now resonatord@NAME")
    sys.stdout.writelines(f"{line}\n" for line in lines)


def _places(done: "Installation") -> "Iterator[tuple[str, Action]]":
    """Yield each file with what is done with it; pages of the manual as one where they fare alike."""
    pages = [file for file in done.placed if file.path.parent.name == "man1"]
    alike = len({file.action for file in pages}) == 1
    for file in done.placed:
        if not alike or file not in pages:
            yield str(file.path), file.action
    if alike:
        yield f"{pages[0].path.parent}, {len(pages)} pages", pages[0].action


def _as_json(done: "Installation", *, dry_run: bool, ok: bool) -> dict[str, object]:
    return {
        "verb": "install",
        "ok": ok,
        "program": str(done.program),
        "warning": done.warning,
        "dry_run": dry_run,
        "files": [{"path": str(file.path), "action": file.action} for file in done.placed],
        "commands": [
            {"command": " ".join(command), "done": done.run and error is None, "error": error}
            for command, error in done.commands
        ],
    }
