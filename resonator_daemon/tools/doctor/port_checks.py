"""The serial port: is it there, may it be opened, who has it, and which helpers of the system disturb it."""

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from resonator_daemon.base.host.text import page
from resonator_daemon.board.links.port_holders import Holder, Holders, is_pseudo_terminal
from resonator_daemon.tools.doctor.finding import Amount, Area, Check, Finding, not_checked
from resonator_daemon.tools.doctor.host import Host
from resonator_daemon.tools.doctor.usb_checks import usb_device_of

EXISTS: Final = Check("port.exists", Area.WIRING, "port")
PERMISSION: Final = Check("port.permission", Area.WIRING, "permission on the port")
HOLDER: Final = Check("port.holder", Area.WIRING, "who else has the port open")
MODEM_MANAGER: Final = Check("port.modem_manager", Area.SOFTWARE, "ModemManager")
BRLTTY: Final = Check("port.brltty", Area.SOFTWARE, "brltty")
LATENCY_TIMER: Final = Check("port.latency_timer", Area.SOFTWARE, "latency timer of the adapter")

_OF_A_PORT: Final = (PERMISSION, HOLDER, MODEM_MANAGER, BRLTTY, LATENCY_TIMER)
_LATENCY_LIMIT_MS: Final = 1
_IGNORED: Final = re.compile(r"^E:ID_MM_(PORT|DEVICE)_IGNORE=1$", re.MULTILINE)
_RULES: Final = ("/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
_RULES_FILE: Final = f"the rules of {page('how-to/connect.md')}, or: resonatord install"


def check_port(port: str, host: Host, holders: Holders) -> Iterator[Finding]:
    """Yield the findings on a serial port, without opening it; `holders` have it open."""
    path = host.at(port)
    absent = _absent(path, port, host)
    if absent is not None:
        yield absent
        yield from not_checked(_OF_A_PORT, "the port is not there")
        return
    device = os.path.realpath(path)
    pseudo = is_pseudo_terminal(device)
    yield EXISTS.ok(f"{port} is there{f' ({device})' if device != str(path) else ''}")
    yield _permission(path, port, host)
    yield check_holder(holders, port, pseudo=pseudo)
    if pseudo:
        yield from not_checked((MODEM_MANAGER, BRLTTY, LATENCY_TIMER), "a pseudo-terminal has no adapter")
        return
    name = os.path.basename(device)
    yield _modem_manager(device, name, host)
    yield _brltty(name, host)
    yield _latency_timer(name, host)


def others(holders: Holders) -> tuple[Holder, ...]:
    """Return who holds a port besides this process; of a pseudo-terminal's, those that locked it."""
    return tuple(holder for holder in holders.processes if holder.pid != os.getpid())


def _absent(path: Path, name: str, host: Host) -> Finding | None:
    if os.path.lexists(path) and not os.path.exists(path):
        return EXISTS.fault(
            f"{name} is a link to {os.readlink(path)}, which is not there", "plug the board in, or restart it"
        )
    if not os.path.exists(path):
        present = sorted(str(entry.name) for entry in host.at("/dev/serial/by-id").glob("*"))
        instead = (
            f"present below /dev/serial/by-id: {', '.join(present)}" if present else "no USB serial port is present"
        )
        stolen = "; brltty is installed, and takes some adapters away" if _brltty_rules(host) else ""
        return EXISTS.fault(
            f"there is no {name}; {instead}{stolen}",
            "plug the board in, check cable and power, or correct `link` (resonatord ports lists them)",
        )
    if not stat.S_ISCHR(os.stat(path).st_mode):
        return EXISTS.fault(f"{name} is no serial port but a file", "correct `link`; resonatord ports lists the ports")
    return None


def _permission(path: Path, name: str, host: Host) -> Finding:
    if host.may_use(path):
        return PERMISSION.ok("this user may open it")
    status = os.stat(path)
    try:
        group = path.group()
    except KeyError:  # a number without a name, as in a container
        group = ""
    mode = f"mode {stat.S_IMODE(status.st_mode):04o}, group {group or status.st_gid}"
    if group in ("", "root") or not status.st_mode & stat.S_IWGRP:
        return PERMISSION.fault(f"{name} may not be opened ({mode})", f"give it to a group of this user: {_RULES_FILE}")
    return PERMISSION.fault(f"{name} may not be opened ({mode})", f"sudo usermod -aG {group} $USER, then log in again")


def check_holder(holders: Holders, name: str, *, pseudo: bool = False) -> Finding:
    """Return who else has a port or a USB device open; of a pseudo-terminal the other end has it, too."""
    found = [holder for holder in others(holders) if holder.locks or not pseudo]
    if found:
        who = " and ".join(str(holder) for holder in found)
        return HOLDER.fault(f"{name} is held by {who}", "end that program, or have it use another port")
    if not holders.all_seen:
        return HOLDER.ok(f"nobody that this user may see; as root: fuser -v {name}")
    return HOLDER.ok("nobody")


def _modem_manager(device: str, name: str, host: Host) -> Finding:
    if not name.startswith(("ttyACM", "ttyUSB")):
        return MODEM_MANAGER.not_checked("it leaves ports alone that are not on USB")
    if not host.running("ModemManager"):
        return MODEM_MANAGER.ok("it does not run")
    number = os.stat(device).st_rdev
    known = host.text(f"/run/udev/data/c{os.major(number)}:{os.minor(number)}") or ""
    if _IGNORED.search(known):
        return MODEM_MANAGER.ok("it runs, and a udev rule keeps it away from this port")
    return MODEM_MANAGER.warning(
        "it runs, and no udev rule keeps it away: it sends to the board for seconds whenever that is plugged in",
        f"{_RULES_FILE}; or, where there is no modem: sudo systemctl disable --now ModemManager",
    )


def _brltty(name: str, host: Host) -> Finding:
    device = usb_device_of(name, host)
    rules = _brltty_rules(host)
    if not rules and not host.running("brltty"):
        return BRLTTY.ok("it is not installed")
    ids = None if device is None else (host.text(device / "idVendor"), host.text(device / "idProduct"))
    if ids is not None and None not in ids and _claims(rules, f"{ids[0]}", f"{ids[1]}"):
        return BRLTTY.warning(
            f"its udev rules take adapters {ids[0]}:{ids[1]} for braille displays, and the port away with them",
            "sudo apt-get remove brltty, or take the line with these ids out of its rules",
        )
    return BRLTTY.ok("it is installed, and its rules do not name this adapter")


def _brltty_rules(host: Host) -> str:
    files = [file for directory in _RULES for file in host.at(directory).glob("*brltty*.rules")]
    lines = [line for file in files for line in file.read_text(errors="replace").splitlines()]
    return "\n".join(line for line in lines if not line.lstrip().startswith("#"))


def _claims(rules: str, vendor: str, product: str) -> bool:
    """Return whether rules name these ids, as `PRODUCT=="1a86/7523/*"` does, without leading zeros."""
    vendor, product = (text.lstrip("0").lower() for text in (vendor, product))
    return f"{vendor}/{product}/" in rules.lower()


def _latency_timer(name: str, host: Host) -> Finding:
    file = f"/sys/class/tty/{name}/device/latency_timer"
    text = host.text(file)
    if text is None or not text.isdecimal():
        return LATENCY_TIMER.ok("this adapter has none")
    timer_ms = int(text)
    if timer_ms <= _LATENCY_LIMIT_MS:
        return LATENCY_TIMER.ok(f"{timer_ms} ms", Amount(float(timer_ms), float(_LATENCY_LIMIT_MS), "ms"))
    if host.may_use(host.at(file)):
        return LATENCY_TIMER.ok(f"{timer_ms} ms; it is set to {_LATENCY_LIMIT_MS} ms when the port is opened")
    return LATENCY_TIMER.warning(
        f"bytes wait up to {timer_ms} ms in the adapter, at most {_LATENCY_LIMIT_MS} ms is meant",
        'a udev rule: ACTION=="add", SUBSYSTEM=="usb-serial", ATTR{latency_timer}="1"',
        Amount(float(timer_ms), float(_LATENCY_LIMIT_MS), "ms"),
    )
