"""The port of a link: serial port or USB device, who may open it and who has it open, and what disturbs it."""

import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from resonator_daemon.board.links.port_holders import Holder, Holders, is_pseudo_terminal
from resonator_daemon.board.links.target import UsbId
from resonator_daemon.tools.doctor.finding import Finding, make_check, not_checked
from resonator_daemon.tools.doctor.host_checks import Host

EXISTS: Final = make_check("port.exists")
PERMISSION: Final = make_check("port.permission")
HOLDER: Final = make_check("port.holder")
MODEM_MANAGER: Final = make_check("port.modem_manager")
LATENCY_TIMER: Final = make_check("port.latency_timer", "ms", warning_above=1.0)
DEVICE: Final = make_check("usb.device")
AUTOSUSPEND: Final = make_check("usb.autosuspend")

_IGNORED: Final = re.compile(r"^E:ID_MM_(PORT|DEVICE)_IGNORE=1$", re.MULTILINE)
_DEVICES: Final = "/sys/bus/usb/devices"


def check_port(port: str, host: Host, holders: Holders) -> Iterator[Finding]:
    """Yield the findings on a serial port, without opening it; `holders` have it open."""
    path = host.at(port)
    absent = _absent(path, port, host)
    if absent is not None:
        yield absent
        yield from not_checked((PERMISSION, HOLDER, MODEM_MANAGER, LATENCY_TIMER), "the port is not there")
        return
    device = os.path.realpath(path)
    pseudo = is_pseudo_terminal(device)
    yield EXISTS.ok(f"{port} is there{f' ({device})' if device != str(path) else ''}")
    yield _permission(path, port, host)
    yield check_holder(holders, port, pseudo=pseudo)
    if pseudo:
        yield from not_checked((MODEM_MANAGER, LATENCY_TIMER), "a pseudo-terminal has no adapter")
        return
    name = os.path.basename(device)
    yield _modem_manager(device, name, host)
    yield _latency_timer(name, host)


def _absent(path: Path, name: str, host: Host) -> Finding | None:
    if os.path.lexists(path) and not os.path.exists(path):
        target = os.readlink(path)
        return EXISTS.fault(f"{name} is a link to {target}, which is not there", "plug the board in, or restart it")
    if not os.path.exists(path):
        present = sorted(str(entry.name) for entry in host.at("/dev/serial/by-id").glob("*"))
        instead = (
            f"present below /dev/serial/by-id: {', '.join(present)}" if present else "no USB serial port is present"
        )
        stolen = "; brltty is installed, and takes some adapters away" if host.rules("brltty") else ""
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
    evidence = f"{name} may not be opened (mode {stat.S_IMODE(status.st_mode):04o}, group {group or status.st_gid})"
    if group in ("", "root") or not status.st_mode & stat.S_IWGRP:
        return PERMISSION.fault(evidence)
    return PERMISSION.fault(evidence, f"sudo usermod -aG {group} $USER, then log in again")


def check_holder(holders: Holders, name: str, *, pseudo: bool = False) -> Finding:
    """Return who else has a port or a USB device open; of a pseudo-terminal the other end has it, too."""
    others: list[Holder] = [
        holder for holder in holders.processes if holder.pid != os.getpid() and (holder.locks or not pseudo)
    ]
    if others:
        return HOLDER.fault(f"{name} is held by {' and '.join(map(str, others))}")
    return HOLDER.ok("nobody" if holders.all_seen else f"nobody that this user may see; as root: fuser -v {name}")


def _modem_manager(device: str, name: str, host: Host) -> Finding:
    if not name.startswith(("ttyACM", "ttyUSB")):
        return MODEM_MANAGER.not_checked("it leaves ports alone that are not on USB")
    if not host.running("ModemManager"):
        return MODEM_MANAGER.ok("it does not run")
    number = os.stat(device).st_rdev
    known = host.text(f"/run/udev/data/c{os.major(number)}:{os.minor(number)}") or ""
    if _IGNORED.search(known):
        return MODEM_MANAGER.ok("it runs, and a udev rule keeps it away from this port")
    return MODEM_MANAGER.warning("it runs, and no udev rule excludes this port: it sends to a new board for seconds")


def _latency_timer(name: str, host: Host) -> Finding:
    file = f"/sys/class/tty/{name}/device/latency_timer"
    text = host.text(file)
    if text is None or not text.isdecimal():
        return LATENCY_TIMER.ok("this adapter has none")
    limit = f"{LATENCY_TIMER.warning_above:g} ms"
    found = LATENCY_TIMER.judged(int(text), f"bytes wait up to {text} ms in the adapter, at most {limit} is meant")
    if found.bad and host.may_use(host.at(file)):
        return LATENCY_TIMER.ok(f"{text} ms; it is set to {limit} when the port is opened")
    return found


def usb_device_of(tty: str, host: Host) -> Path | None:
    """Return the directory of the USB device behind a terminal as /sys has it; None where it is none."""
    place = host.at(f"/sys/class/tty/{tty}/device")
    if not place.exists():
        return None
    root = Path(os.path.realpath(host.root))
    for directory in (here := Path(os.path.realpath(place)), *here.parents):
        if (directory / "idVendor").exists():
            return Path("/") / directory.relative_to(root)
    return None


def usb_node(link: UsbId, host: Host) -> Path | None:
    """Return the device file of the device that a USB link names; None where it is none, or not the only one."""
    found = list(_named(link, host))
    return host.at(_node(found[0], host)) if len(found) == 1 else None


def _node(device: Path, host: Host) -> str:
    bus, number = (host.text(device / name) or "0" for name in ("busnum", "devnum"))
    return f"/dev/bus/usb/{int(bus):03d}/{int(number):03d}"


def _named(link: UsbId, host: Host) -> Iterator[Path]:
    for directory in sorted(host.at(_DEVICES).glob("*")):
        device = Path(_DEVICES) / directory.name
        ids = host.text(device / "idVendor"), host.text(device / "idProduct")
        if ids == (f"{link.vendor_id:04x}", f"{link.product_id:04x}") and (
            link.serial_number in (None, host.text(device / "serial"))
        ):
            yield device


def check_usb_link(link: UsbId, host: Host) -> Iterator[Finding]:
    """Yield the findings on the device that a USB link names."""
    found = list(_named(link, host))
    wanted = f"{link.vendor_id:04x}:{link.product_id:04x}" + (
        f", serial {link.serial_number}" if link.serial_number else ""
    )
    if len(found) != 1:
        if found:
            yield DEVICE.fault(f"{len(found)} USB devices are {wanted}", "name one by `?serial=` in `link`")
        else:
            remedy = "plug the board in, check cable and power, or correct `link`"
            yield DEVICE.fault(f"no USB device {wanted} is present", remedy)
        yield AUTOSUSPEND.not_checked("the device of the link is not known")
        return
    node = _node(found[0], host)
    if host.may_use(host.at(node)):
        yield DEVICE.ok(f"{wanted} is there, and this user may open it")
    else:
        yield DEVICE.fault(f"{wanted} is there, and this user may not open {node}")
    yield check_usb_device(found[0], host)


def check_usb_device(device: Path, host: Host) -> Finding:
    """Return whether the kernel may put a device to sleep."""
    control = host.text(device / "power/control")
    if control is None:
        return AUTOSUSPEND.not_checked("the kernel does not report it")
    delay_ms = host.text(device / "power/autosuspend_delay_ms") or ""
    if control == "on" or delay_ms.startswith("-"):
        return AUTOSUSPEND.ok("off")
    delay = f"the device may be put to sleep after {delay_ms or '?'} ms without traffic"
    return AUTOSUSPEND.warning(f"on (power/control = {control}): {delay}")
