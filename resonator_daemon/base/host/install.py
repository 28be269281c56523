"""Installation of units, udev rules, user, completion and manual, from the wheel that this program runs from."""

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
HIDDEN_FROM_SERVICES = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # by ProtectHome= and PrivateTmp=
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
_Commands = tuple[tuple[tuple[str, ...], Path | None], ...]  # each with what has to run
_RELOADS: _Commands = (
    (("systemctl", "daemon-reload"), SYSTEMD_RUNNING),
    (("udevadm", "control", "--reload"), UDEV_RUNNING),
)
# Those that need nobody running prepare an image, too.
_COMMANDS: _Commands = (
    (("systemd-sysusers", "/etc/sysusers.d/resonatord.conf"), None),
    (("systemd-tmpfiles", "--create", "/etc/tmpfiles.d/resonatord.conf"), None),
    *_RELOADS,
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
    """A file in its place, below the prefix."""

    path: Path
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
        Text of each file that the program makes itself, by its place: example configuration, completion.
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
    run = _may_run_commands(prefix, dry_run, "install")
    shipped = resources.files("resonator_daemon") / "service_files"
    texts = {place: (shipped / name).read_text("utf-8") for name, place in _PLACES.items()} | dict(made)
    placed = [_put(_below(prefix, place), sealed(started_by(text, program)), dry_run) for place, text in texts.items()]
    return Installation(program, hidden, placed, _done(_COMMANDS if prefix is None else (), run), run)


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
    run = _may_run_commands(prefix, dry_run, "uninstall")
    places = [_below(prefix, place) for place in (*_PLACES.values(), *made)]
    commands = _done(_commands_that_stop() if prefix is None else (), run)
    placed = [_remove(path, dry_run) for path in places if os.path.lexists(path)]
    commands += _done(_RELOADS if prefix is None else (), run)
    return Installation(Path(sys.executable).with_name("resonatord"), None, placed, commands, run)


def _below(prefix: Path | None, place: str) -> Path:
    return (prefix or Path("/")) / place.lstrip("/")


def _put(path: Path, content: str, dry_run: bool) -> Placed:
    """Write a whole file where nobody has changed it: an interrupted one is begun again by the next run."""
    there = _read(path)
    if there == content:
        return Placed(path, Action.UNCHANGED)
    if there is not None and not _is_intact(there):
        return Placed(path, Action.KEPT)
    if dry_run:
        return Placed(path, Action.WOULD_WRITE if there is None else Action.WOULD_UPDATE)
    try:
        replace_file(path, content.encode(), 0o644)
    except OSError as error:
        if error.errno == errno.EROFS and "share" in path.parts:  # as on computers whose /usr is an image
            return Placed(path, Action.READ_ONLY)
        raise InstallError(f"{path} cannot be written: {meaning_of(error)}") from error
    return Placed(path, Action.WRITTEN if there is None else Action.UPDATED)


def _remove(path: Path, dry_run: bool) -> Placed:
    if not _is_intact(_read(path) or ""):
        return Placed(path, Action.KEPT)
    if dry_run:
        return Placed(path, Action.WOULD_REMOVE)
    try:
        path.unlink()
    except OSError as error:
        raise InstallError(f"{path} cannot be removed: {error.strerror}") from error
    return Placed(path, Action.REMOVED)


def _read(path: Path) -> str | None:
    try:
        return path.read_bytes().decode(errors="replace")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InstallError(f"{path}: {meaning_of(error)}") from error


def _commands_that_stop() -> _Commands:
    """Return the commands that stop the services of the present system, and disable those that start with it."""
    wanted = Path("/etc/systemd/system").glob("*.wants/resonatord*@*.service")
    enabled = tuple(sorted({path.name for path in wanted}))
    stop = ("systemctl", "stop", "resonatord@*.service", "resonatord-decode@*.service", "resonatord-view@*.service")
    disable = ((("systemctl", "disable", *enabled), SYSTEMD_RUNNING),) if enabled else ()
    return (*disable, (stop, SYSTEMD_RUNNING))


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


def started_by(text: str, program: Path) -> str:
    """Return the text of a unit that starts a program, its path escaped as units have it."""
    escaped = str(program).replace("\\", "\\\\").replace("%", "%%").replace(" ", "\\x20")  # systemd.service(5)
    return with_pages(text.replace(f"ExecStart={_PROGRAM_IN_UNITS}", f"ExecStart={escaped}"))


def sealed(text: str) -> str:
    """Return the text with a last line by which `_is_intact` detects whether it was changed."""
    return f"{text}# resonatord install {hashlib.sha256(text.encode()).hexdigest()}\n"


def _is_intact(text: str) -> bool:
    return text == sealed(_SEAL.sub("", text))


def _done(commands: _Commands, run: bool) -> list[tuple[tuple[str, ...], str | None]]:
    """Return those commands whose program runs here, with what went wrong when they were run."""
    due = [command for command, needed in commands if needed is None or needed.exists()]
    return [(command, run_command(command) if run else None) for command in due]


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
