"""The USB device behind a link: whether it is put to sleep, how fast it is connected, and through which hubs."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from resonator_daemon.base.host.text import page
from resonator_daemon.board.links.target import UsbId
from resonator_daemon.tools.doctor.finding import Amount, Area, Check, Finding, not_checked
from resonator_daemon.tools.doctor.host import Host

DEVICE: Final = Check("usb.device", Area.WIRING, "USB device")
AUTOSUSPEND: Final = Check("usb.autosuspend", Area.SOFTWARE, "USB autosuspend")
SPEED: Final = Check("usb.speed", Area.WIRING, "USB speed")
HUBS: Final = Check("usb.hubs", Area.WIRING, "USB path")

_FULL_SPEED_MBIT: Final = 12
_FULL_SPEED_USABLE: Final = 0.6  # of the bits; the rest are frames, polls and other devices
_HUBS_WARNING: Final = 2
_DEVICES: Final = "/sys/bus/usb/devices"


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


def check_usb_link(link: UsbId, host: Host, load_bit_per_s: float | None) -> Iterator[Finding]:
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
        reason = "which of them is meant is not known" if found else "the device is not there"
        yield from not_checked((AUTOSUSPEND, SPEED, HUBS), reason)
        return
    node = _node(found[0], host)
    if host.may_use(host.at(node)):
        yield DEVICE.ok(f"{wanted} is there, and this user may open it")
    else:
        yield DEVICE.fault(
            f"{wanted} is there, and this user may not open {node}",
            f"a udev rule gives it to a group of this user: {page('how-to/connect.md')}, or: resonatord install",
        )
    yield from check_usb_device(found[0], host, load_bit_per_s)


def check_usb_device(device: Path, host: Host, load_bit_per_s: float | None) -> Iterator[Finding]:
    """Yield how a device is connected; `load_bit_per_s` is what the plate's frames need, None where it is not known."""
    yield _autosuspend(device, host)
    yield _speed(device, host, load_bit_per_s)
    yield _hubs(device)


def _named(link: UsbId, host: Host) -> Iterator[Path]:
    for directory in sorted(host.at(_DEVICES).glob("*")):
        device = Path(_DEVICES) / directory.name
        ids = host.text(device / "idVendor"), host.text(device / "idProduct")
        if ids == (f"{link.vendor_id:04x}", f"{link.product_id:04x}") and (
            link.serial_number in (None, host.text(device / "serial"))
        ):
            yield device


def _autosuspend(device: Path, host: Host) -> Finding:
    control = host.text(device / "power/control")
    if control is None:
        return AUTOSUSPEND.not_checked("the kernel does not report it")
    delay_ms = host.text(device / "power/autosuspend_delay_ms") or ""
    if control == "on" or delay_ms.startswith("-"):
        return AUTOSUSPEND.ok("off")
    return AUTOSUSPEND.warning(
        f"on (power/control = {control}): the device may be put to sleep after {delay_ms or '?'} ms without traffic",
        'a udev rule: TEST=="power/control", ATTR{power/control}="on" '
        f"({page('how-to/connect.md')}, or: resonatord install)",
    )


def _speed(device: Path, host: Host, load_bit_per_s: float | None) -> Finding:
    text = host.text(device / "speed") or ""
    try:
        speed_mbit = float(text)
    except ValueError:
        return SPEED.not_checked("the kernel does not report it")
    usable_mbit = _FULL_SPEED_USABLE * speed_mbit
    if load_bit_per_s is None:
        return SPEED.ok(f"{speed_mbit:g} Mbit/s", Amount(speed_mbit, None, "Mbit/s"))
    needed_mbit = load_bit_per_s * 1e-6
    evidence = f"{speed_mbit:g} Mbit/s, of which {usable_mbit:g} can be counted on; the frames need {needed_mbit:.2g}"
    if needed_mbit <= usable_mbit:
        return SPEED.ok(evidence, Amount(needed_mbit, usable_mbit, "Mbit/s"))
    remedy = "connect it to a port, and by a cable, of a higher speed"
    if speed_mbit > _FULL_SPEED_MBIT:
        remedy = "lower counter.frame_rate_hz of the plate"
    return SPEED.fault(evidence, remedy, Amount(needed_mbit, usable_mbit, "Mbit/s"))


def _hubs(device: Path) -> Finding:
    hubs = device.name.count(".")
    way = f"{device.name}: {'straight to the computer' if not hubs else f'through {hubs} hub(s)'}"
    if hubs <= _HUBS_WARNING:
        return HUBS.ok(way, Amount(float(hubs), float(_HUBS_WARNING), "hubs"))
    return HUBS.warning(
        f"{way}, at most {_HUBS_WARNING} are meant",
        "connect it nearer to the computer: each hub adds delay, and shares its power and bandwidth",
        Amount(float(hubs), float(_HUBS_WARNING), "hubs"),
    )
