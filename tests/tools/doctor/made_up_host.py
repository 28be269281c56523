"""A made-up computer below a directory: what /sys, /proc, /etc, /run and /dev would have; and findings by their ids."""

from collections.abc import Iterable
from pathlib import Path

from resonator_daemon.tools.doctor.finding import Finding, Outcome
from resonator_daemon.tools.doctor.host_checks import Host

USB = "sys/devices/pci0/usb1/1-1/1-1.4"


class MadeUpHost:
    """Files of a computer with one USB adapter, ttyUSB0; its port is /dev/null under another name."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.write(f"{USB}/idVendor", "1a86")
        self.write(f"{USB}/idProduct", "7523")
        self.write(f"{USB}/serial", "0042")
        self.write(f"{USB}/speed", "12")
        self.write(f"{USB}/busnum", "1")
        self.write(f"{USB}/devnum", "7")
        self.write(f"{USB}/power/control", "on")
        self.write(f"{USB}/1-1.4:1.0/ttyUSB0/latency_timer", "1")
        self.link("sys/class/tty/ttyUSB0/device", self.root / f"{USB}/1-1.4:1.0/ttyUSB0")
        self.link("sys/bus/usb/devices/1-1.4", self.root / USB)
        self.write("dev/bus/usb/001/007", "")
        self.write("proc/1/comm", "init")

    def write(self, path: str, text: str) -> None:
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text + "\n")

    def link(self, path: str, target: Path) -> None:
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.symlink_to(target)

    def host(self, *, closed: str = "") -> Host:
        """Return it as checks see it; `closed` is in the name of what this user may not open."""
        return Host(self.root, lambda path: not closed or closed not in str(path))


def by_id(findings: Iterable[Finding]) -> dict[str, Finding]:
    return {finding.id: finding for finding in findings}


def bad(findings: dict[str, Finding]) -> dict[str, Outcome]:
    """Return the outcomes of those with something wrong."""
    return {name: finding.outcome for name, finding in findings.items() if finding.bad}
