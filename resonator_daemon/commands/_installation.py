"""Files that `install` places and `uninstall` removes, and the output of both."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from resonator_daemon.commands._output import print_json
from resonator_daemon.errors import ExitCode
from resonator_daemon.host.printable import print_note

if TYPE_CHECKING:
    from collections.abc import Iterator

    from resonator_daemon.host.install import Action, Installation


def made_files() -> dict[str, str]:
    """Return text by place of the files that the program makes itself: example, completion, manual."""
    from resonator_daemon.commands._completion import completions
    from resonator_daemon.commands._manual import manual
    from resonator_daemon.config import example_config
    from resonator_daemon.host.documentation import with_pages
    from resonator_daemon.host.install import EXAMPLE

    return {EXAMPLE: with_pages(example_config()), **dict(completions()), **dict(manual())}


def report(verb: str, done: "Installation", prefix: Path | None, *, dry_run: bool, as_json: bool) -> ExitCode:
    """Print what was done; InstallError where a step failed."""
    from resonator_daemon.host.install import InstallError

    failed = [f"{' '.join(command)}: {error}" for command, error in done.commands if error]
    if not as_json:
        _print(verb, done, prefix)
    if failed:
        raise InstallError(*failed, so_far=_as_json(done, dry_run=dry_run))
    if as_json:
        print_json({"verb": verb, "ok": True, **_as_json(done, dry_run=dry_run)})
    return ExitCode.DONE


def _print(verb: str, done: "Installation", prefix: Path | None) -> None:
    from resonator_daemon.host.install import EXAMPLE, Action

    words = {
        Action.WOULD_WRITE: "would be written",
        Action.WOULD_UPDATE: "would be updated",
        Action.WOULD_REMOVE: "would be removed",
        Action.READ_ONLY: "left out: this file system is read-only",
        Action.KEPT: "kept: it was changed here; `resonatord install --prefix DIR` writes the new one elsewhere"
        if verb == "install"
        else "kept: it was changed here",
    }
    lines = [f"{place}: {words.get(action, str(action))}" for place, action in _places(done)]
    for command, error in done.commands:
        lines.append(f"{' '.join(command)}: {error or ('done' if done.run else 'would be run')}")
    if done.warning:
        print_note(f"warning: {done.warning}")
    elif prefix is None and verb == "install":
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


def _as_json(done: "Installation", *, dry_run: bool) -> dict[str, object]:
    return {
        "program": str(done.program),
        "warning": done.warning,
        "dry_run": dry_run,
        "files": [{"path": str(file.path), "action": file.action} for file in done.placed],
        "commands": [
            {"command": " ".join(command), "done": done.run and error is None, "error": error}
            for command, error in done.commands
        ],
    }
