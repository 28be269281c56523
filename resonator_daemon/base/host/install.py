"""Installation of units, udev rules, user, completion and manual, from the wheel that this program runs from."""

import dataclasses
import errno
import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib import resources
from pathlib import Path, PurePosixPath

from resonator_daemon.base.errors import ExitCode, UserError, meaning_of, reason_of
from resonator_daemon.base.host.files import replace_file
from resonator_daemon.base.host.text import page, with_pages

_PROGRAM_IN_UNITS = "/opt/resonatord/bin/resonatord"
HIDDEN_FROM_SERVICES = (
    "/home",
    "/root",
    "/run/user",
    "/tmp",
    "/var/tmp",
)  # from the service, by ProtectHome= and PrivateTmp=
_PLACES = {
    "resonatord@.service": "/etc/systemd/system/resonatord@.service",
    "resonatord-decode@.service": "/etc/systemd/system/resonatord-decode@.service",
    "resonatord-view@.service": "/etc/systemd/system/resonatord-view@.service",
    "70-resonatord.rules": "/etc/udev/rules.d/70-resonatord.rules",
    "resonatord.sysusers": "/etc/sysusers.d/resonatord.conf",
    "resonatord.tmpfiles": "/etc/tmpfiles.d/resonatord.conf",
}
EXAMPLE = "/etc/resonatord/example.toml"
_SEAL = re.compile(r"(?:#|\.\\\") resonatord install [0-9a-f]{64}\n\Z")
SYSTEMD_RUNNING, UDEV_RUNNING = Path("/run/systemd/system"), Path("/run/udev/control")  # there while they run
# Those that need nobody running prepare an image, too.
_COMMANDS: tuple[tuple[tuple[str, ...], Path | None], ...] = (
    (("systemd-sysusers", "/etc/sysusers.d/resonatord.conf"), None),
    (("systemd-tmpfiles", "--create", "/etc/tmpfiles.d/resonatord.conf"), None),
    (("systemctl", "daemon-reload"), SYSTEMD_RUNNING),
    (("udevadm", "control", "--reload"), UDEV_RUNNING),
    (
        ("udevadm", "trigger", "--action=change", "--attr-match=idVendor=1209", "--attr-match=idProduct=0001"),
        UDEV_RUNNING,
    ),
)
_COMMAND_S = 60.0


class InstallError(UserError):
    """Something could not be put in its place."""

    exit_code = ExitCode.FAILED
    code = "install"
    hint = page("how-to/install.md")


class Action(StrEnum):
    """What is done with a file."""

    WRITTEN = "written"
    UPDATED = "updated"
    WOULD_WRITE = "would_write"
    WOULD_UPDATE = "would_update"
    UNCHANGED = "unchanged"
    KEPT = "kept"  # somebody changed it
    REMOVED = "removed"
    WOULD_REMOVE = "would_remove"
    READ_ONLY = "read_only"  # completion and manual, which services do without


@dataclass(frozen=True)
class Placed:
    """A file in its place.

    Attributes
    ----------
    path
        Where it is, below the prefix.
    content
        What belongs there, with its seal.
    """

    path: Path
    content: str
    action: Action


@dataclass(frozen=True)
class Installation:
    """What was done, or would be on a dry run.

    Attributes
    ----------
    commands
        What is to be run, with what went wrong.
    run
        Whether they were run.
    warning
        Why the services cannot start; None if they can.
    """

    program: Path
    warning: str | None
    placed: list[Placed]
    commands: list[tuple[tuple[str, ...], str | None]]
    run: bool


def install(prefix: Path | None, made: Mapping[str, str], *, dry_run: bool) -> Installation:
    """Put all files in place and run the commands that announce them; return what was done.

    Parameters
    ----------
    prefix
        Below it everything is put, and no command is run: for a package or an image.
    made
        Text of each file that the program makes itself, by its place: example configuration, completion, manual.
    dry_run
        Change nothing, and return what would be done.

    Raises
    ------
    InstallError
        It may not or cannot write there, there is no systemd, or services could not reach this program.
    """
    program = Path(sys.executable).with_name("resonatord")
    if not program.exists():
        raise InstallError(f"{program} is missing: install resonatord into this Python's environment with pip or pipx")
    hidden = _hidden(program)
    if hidden and prefix is None and not dry_run:
        raise InstallError(hidden)
    running = _may_run_commands(prefix, dry_run, "install")
    placed = [_judge(path, content, dry_run) for path, content in _contents(prefix or Path("/"), program, made)]
    placed = [_write(file) for file in placed]
    commands = [(command, run_command(command) if running else None) for command in _due(prefix is None)]
    return Installation(program, hidden, placed, commands, running)


def uninstall(prefix: Path | None, made: Mapping[str, str], *, dry_run: bool) -> Installation:
    """Stop the services, and remove what `install` put in place and nobody has changed; return what was done.

    Configurations, recordings, states and the user stay.

    Parameters
    ----------
    prefix, made, dry_run
        As of `install`.

    Raises
    ------
    InstallError
        It may not or cannot remove a file, or there is no systemd.
    """
    running = _may_run_commands(prefix, dry_run, "uninstall")
    root = prefix or Path("/")
    places = [root / place.lstrip("/") for place in (*_PLACES.values(), *made)]
    pages = [place for place in places if place.parent.name == "man1"]
    older = {page for folder in {page.parent for page in pages} for page in folder.glob("resonatord*.1")}
    commands = [(command, run_command(command) if running else None) for command in _due_before(prefix is None)]
    action = Action.WOULD_REMOVE if dry_run else Action.REMOVED
    found = [_judge_removal(path, action) for path in dict.fromkeys((*places, *sorted(older)))]
    placed = [_remove(file) for file in found if file is not None]
    commands += [(command, run_command(command) if running else None) for command in _due_after(prefix is None)]
    return Installation(Path(sys.executable).with_name("resonatord"), None, placed, commands, running)


def _judge_removal(path: Path, action: Action) -> Placed | None:
    try:
        there = path.read_bytes().decode(errors="replace")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InstallError(f"{path}: {error.strerror}") from error
    return Placed(path, there, action if there == sealed(_SEAL.sub("", there)) else Action.KEPT)


def _remove(file: Placed) -> Placed:
    if file.action is Action.REMOVED:
        try:
            file.path.unlink()
        except OSError as error:
            raise InstallError(f"{file.path} cannot be removed: {error.strerror}") from error
    return file


def _due_before(here: bool) -> list[tuple[str, ...]]:
    """Return the commands that stop the services of the present system, and disable those that start with it."""
    if not here or not SYSTEMD_RUNNING.exists():
        return []
    wanted = Path("/etc/systemd/system").glob("*.wants/resonatord*@*.service")
    enabled = tuple(sorted({path.name for path in wanted}))
    stop = ("systemctl", "stop", "resonatord@*.service", "resonatord-decode@*.service", "resonatord-view@*.service")
    return [*([("systemctl", "disable", *enabled)] if enabled else []), stop]


def _due_after(here: bool) -> list[tuple[str, ...]]:
    """Return the commands that register the removal on the present system."""
    reloads = (("systemctl", "daemon-reload"), SYSTEMD_RUNNING), (("udevadm", "control", "--reload"), UDEV_RUNNING)
    return [command for command, needed in reloads if here and needed.exists()]


def _hidden(program: Path) -> str | None:
    """Return why services cannot start this program; None if they can."""
    real = PurePosixPath(os.path.realpath(program))
    hidden = next((place for place in HIDDEN_FROM_SERVICES if real.is_relative_to(place)), None)
    if hidden is None:
        return None
    return (
        f"{program} is below {hidden}, which services do not see; install it elsewhere: python3 -m venv "
        "/opt/resonatord && /opt/resonatord/bin/pip install resonatord (in a checkout: pip install .)"
    )


def _may_run_commands(prefix: Path | None, dry_run: bool, verb: str) -> bool:
    if prefix is not None or dry_run:
        return False
    if shutil.which("systemctl") is None:
        raise InstallError(
            f"no systemctl on PATH: this computer has no systemd; see {page('how-to/install.md')} for others"
        )
    if os.geteuid() != 0:
        raise InstallError(f"only root may write to /etc: sudo {sys.argv[0]} {verb}, or look first with --dry-run")
    return True


def _contents(root: Path, program: Path, made: Mapping[str, str]) -> list[tuple[Path, str]]:
    """Return each file's place and content."""
    shipped = resources.files("resonator_daemon") / "service_files"
    texts = {place: (shipped / name).read_text("utf-8") for name, place in _PLACES.items()} | dict(made)
    return [(root / place.lstrip("/"), sealed(started_by(text, program))) for place, text in texts.items()]


def started_by(text: str, program: Path) -> str:
    """Return the text of a unit that starts a program, its path escaped as units have it."""
    escaped = str(program).replace("\\", "\\\\").replace("%", "%%").replace(" ", "\\x20")  # systemd.service(5)
    return with_pages(text.replace(f"ExecStart={_PROGRAM_IN_UNITS}", f"ExecStart={escaped}"))


def sealed(text: str) -> str:
    """Return the text with a last line by which `_judge` detects whether it was changed."""
    comment = '.\\"' if text.startswith(".") else "#"  # of roff, or of units, rules and shells
    return f"{text}{comment} resonatord install {hashlib.sha256(text.encode()).hexdigest()}\n"


def _judge(path: Path, content: str, dry_run: bool) -> Placed:
    write, update = (Action.WOULD_WRITE, Action.WOULD_UPDATE) if dry_run else (Action.WRITTEN, Action.UPDATED)
    try:
        there = path.read_bytes().decode(errors="replace")
    except FileNotFoundError:
        return Placed(path, content, write)
    except OSError as error:
        raise InstallError(f"{path}: {meaning_of(error)}") from error
    if there == content:
        return Placed(path, content, Action.UNCHANGED)
    intact = there == sealed(_SEAL.sub("", there))
    return Placed(path, content, update if intact else Action.KEPT)


def _write(file: Placed) -> Placed:
    """Write whole files only: an interrupted one is begun again by the next run."""
    if file.action not in (Action.WRITTEN, Action.UPDATED):
        return file
    try:
        replace_file(file.path, file.content.encode(), 0o644)
    except OSError as error:
        if error.errno == errno.EROFS and "share" in file.path.parts:  # as on computers whose /usr is an image
            return dataclasses.replace(file, action=Action.READ_ONLY)
        raise InstallError(f"{file.path} cannot be written: {meaning_of(error)}") from error
    return file


def _due(here: bool) -> list[tuple[str, ...]]:
    """Return the commands that register the files on the present system; none of it where they are for another."""
    return [command for command, needed in _COMMANDS if here and (needed is None or needed.exists())]


def run_command(command: tuple[str, ...]) -> str | None:
    """Run a command; return what went wrong, or None."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_COMMAND_S, check=False
        )
    except OSError as error:
        return reason_of(error)
    except subprocess.TimeoutExpired as error:
        return str(error)
    return (" ".join(done.stderr.split()) or f"exit code {done.returncode}") if done.returncode else None
