"""Opens whatever kind of link a configuration names."""

from resonator_daemon.config import LinkTarget, ReplayLink, SerialLink, TcpLink, UsbLink
from resonator_daemon.links.link import Link, LinkUnavailableError
from resonator_daemon.links.serial import open_serial
from resonator_daemon.links.tcp import open_tcp


def open_link(target: LinkTarget) -> Link:
    """Open a link. Raises LinkUnavailableError."""
    match target:
        case SerialLink():
            return open_serial(target)
        case TcpLink():
            return open_tcp(target)
        case UsbLink():
            from resonator_daemon.links.usb import open_usb  # loads libusb

            return open_usb(target)
        case ReplayLink():
            raise LinkUnavailableError(f"{target} is a recording: it can be replayed, and no board answers there")
