"""The USB side of an emulated board: what the kernel's usbfs would answer for a plugged-in device.

A program of its own, for the system's Python: umockdev is reached through python3-gi, which virtual environments lack.
`simulators.usb_link` starts it. Both are joined by sockets that keep messages apart; the first byte of each is its
kind. Programs that are started with umockdev's library preloaded see one
USB device, through unmodified libusb and pyusb.
"""

import errno
import shutil
import socket
import struct
import sys
from collections import deque
from typing import Any

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402 - the version must be chosen before

# Between board and device: bytes, begin again, have begun again, where the bus is.
DATA, BEGIN, BEGUN, READY = b"dBbr"
# On a socket of its own, for data that nobody takes must not hold it up: pull the cable, put it back, answer a transfer
# with a stall, keep cancelled transfers from now on.
UNPLUG, PLUG, STALL, HOLD = b"uxsh"

# Also in usb_link.py and firmware_protocol: the system's Python has no packages of this project.
VENDOR_ID, PRODUCT_ID = 0x1209, 0x0001
_PROTOCOL_MAJOR = 1
ENDPOINT_OUT, ENDPOINT_IN = 0x01, 0x81
_BULK_PACKET_BYTES = 512  # at high speed
_REQUEST_BEGIN = (0x41, 0x01)  # bmRequestType, bRequest
_REQUEST_GET_DESCRIPTOR = (0x80, 0x06)
_DESCRIPTOR_STRING = 3

# linux/usbdevice_fs.h, as 64-bit machines lay it out.
_SUBMITURB, _DISCARDURB, _REAPURB, _REAPURBNDELAY = 0x8038550A, 0x550B, 0x4008550C, 0x4008550D
_CLAIMINTERFACE, _RELEASEINTERFACE = 0x8004550F, 0x80045510
_SETCONFIGURATION, _SETINTERFACE, _CLEAR_HALT = 0x80045505, 0x80085504, 0x80045515
_GETDRIVER, _GET_CAPABILITIES = 0x41045508, 0x8004551A
_CAPABILITIES = 0x01 | 0x04 | 0x10  # zero packets, no limit to a transfer's size, reap after disconnection
_URB_BYTES, _URB_STATUS, _URB_BUFFER, _URB_LENGTH, _URB_ACTUAL_LENGTH = 56, 4, 16, 24, 28
_URB_CONTROL = 2
_SETUP_BYTES = 8  # in a control transfer's buffer, before the data

_MESSAGE_BYTES_MAX = 1 + 65536
_REST_BYTES = 16384  # of the device's own memory: frames that wait for the host go together
_REAP_WAIT_MS = 4  # the fake node polls as ready all the time: answered at once, the host would spin


def device_descriptors() -> bytes:
    """Return the descriptors of device and configuration, one after the other."""
    device = struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0, 0, 0, 64, VENDOR_ID, PRODUCT_ID, 0x0100, 1, 2, 3, 1)
    interface = struct.pack("<9B", 9, 4, 0, 0, 2, 0xFF, 0x52, 0x01, 0)
    endpoints = b"".join(struct.pack("<BBBBHB", 7, 5, e, 2, _BULK_PACKET_BYTES, 0) for e in (ENDPOINT_OUT, ENDPOINT_IN))
    size = 9 + len(interface) + len(endpoints)
    return device + struct.pack("<BBHBBBBB", 9, 2, size, 1, 1, 0, 0x80, 50) + interface + endpoints


class Urb:
    """A transfer that the host has handed over. Its memory is in reach only while the host waits for an answer."""

    def __init__(self, argument: Any) -> None:
        self.handle = argument.resolve(0, _URB_BYTES)
        raw = bytes(self.handle.retrieve())
        self.where = self.handle.client_addr
        self.type, self.endpoint = raw[0], raw[1]
        (self.size,) = struct.unpack_from("=i", raw, _URB_LENGTH)

    def read(self) -> bytes:
        return bytes(self.handle.resolve(_URB_BUFFER, self.size).retrieve()) if self.size else b""

    def finish(self, status: int, data: bytes, sent: int) -> None:
        """Fill in the result: `data` for the host, or how many bytes it `sent`."""
        offset = _SETUP_BYTES if self.type == _URB_CONTROL else 0
        if data:
            self.handle.resolve(_URB_BUFFER, offset + len(data)).update(offset, data)
        self.handle.update(_URB_STATUS, struct.pack("=i", status))
        self.handle.update(_URB_ACTUAL_LENGTH, struct.pack("=i", sent + len(data)))


class Host:
    """One program that has opened the device's node, and its transfers."""

    def __init__(self) -> None:
        self.waiting: deque[Urb] = deque()  # bulk-in, to be filled
        self.sending: deque[tuple[Urb, bytes]] = deque()  # bulk-out, to the board
        self.beginning: Urb | None = None  # until the board has begun again
        self._done: deque[tuple[Urb, int, bytes, int]] = deque()  # with status, data and bytes sent, to be reaped
        self._reaper: tuple[Any, int] | None = None  # (client, timer): it asked for a finished transfer
        self._reaped = False  # the last time it asked

    def finish(self, urb: Urb, status: int, data: bytes = b"", sent: int = 0) -> None:
        self._done.append((urb, status, data, sent))
        if self._reaper is not None:
            client, timer = self._reaper
            GLib.source_remove(timer)
            self._reap(client)

    def end(self, status: int, where: int | None = None) -> bool:
        """Finish all transfers, or the one of that address; return whether there was one."""
        urbs = [*self.waiting, *(urb for urb, _ in self.sending), *filter(None, [self.beginning])]
        ended = [urb for urb in urbs if where in (None, urb.where)]
        self.waiting = deque(urb for urb in self.waiting if urb not in ended)
        self.sending = deque((urb, data) for urb, data in self.sending if urb not in ended)
        self.beginning = None if self.beginning in ended else self.beginning
        for urb in ended:
            self.finish(urb, status)
        return bool(ended)

    def ask(self, client: Any) -> None:
        """Hand a finished transfer back, now or when one comes."""
        if self._done:
            self._reap(client)
        elif self._reaped:  # libusb asks until nothing is left before it reports any
            self._reaped = False
            client.complete(-1, errno.EAGAIN)
        else:
            self._reaper = (client, GLib.timeout_add(_REAP_WAIT_MS, self._nothing, client))

    def _reap(self, client: Any) -> None:
        self._reaper = None
        self._reaped = True
        urb, status, data, sent = self._done.popleft()
        urb.finish(status, data, sent)
        client.get_arg().resolve(0, 8).set_ptr(0, urb.handle)
        client.complete(0, 0)

    def _nothing(self, client: Any) -> bool:
        self._reaper = None
        client.complete(-1, errno.EAGAIN)
        return False


class Device:
    """The device from one plugging-in to the next: what hosts ask of it, and who has claimed it."""

    def __init__(self, board: socket.socket, strings: dict[int, bytes]) -> None:
        self._board = board
        self._strings = strings
        self._hosts: dict[Any, Host] = {}
        self._plugged = True
        self._claimed_by: Host | None = None
        self._stalls = 0
        self._halted = False
        self._hold = False
        self._rest = b""  # from the board, still to be sent

    @property
    def takes_data(self) -> bool:
        """Whether bytes from the board have somewhere to go; what else is sent waits in the socket."""
        reads = self._claimed_by is not None and self._claimed_by.waiting
        return self._plugged and (self._begins or (bool(reads) and len(self._rest) < _REST_BYTES))

    @property
    def has_data(self) -> bool:
        """Whether the host has sent what the board has not taken."""
        return self._claimed_by is not None and bool(self._claimed_by.sending)

    def from_board(self, data: bytes) -> None:
        if not self._begins:  # until the board has begun again, all its data is old
            self._rest += data

    def to_board(self) -> None:
        """Hand on what the host has sent, as far as the board takes it."""
        host = self._claimed_by
        while host is not None and host.sending:
            urb, data = host.sending[0]
            try:
                self._board.send(bytes([DATA]) + data)
            except BlockingIOError:
                return
            host.sending.popleft()
            host.finish(urb, 0, sent=urb.size)

    def move(self) -> None:
        """Give the host what it can have."""
        host = self._claimed_by
        if host is None:
            return
        while host.waiting and (self._halted or self._stalls):
            if not self._halted:
                self._halted = True
                self._stalls -= 1
            host.finish(host.waiting.popleft(), -errno.EPIPE)
        while host.waiting and self._rest:
            urb = host.waiting.popleft()
            data, self._rest = self._rest[: urb.size], self._rest[urb.size :]
            host.finish(urb, 0, data)

    def begun(self) -> None:
        for host in self._hosts.values():
            if host.beginning is not None:
                urb, host.beginning = host.beginning, None
                host.finish(urb, 0)

    def stall(self) -> None:
        self._stalls += 1
        self.move()

    def hold(self) -> None:
        self._hold = True

    def unplug(self) -> None:
        self._plugged = False
        self._end_all(-errno.ESHUTDOWN)

    def ioctl(self, client: Any) -> None:
        """Answer a system call, at once or later."""
        if client not in self._hosts:
            self._remove_vanished()
            self._hosts[client] = Host()
        host = self._hosts[client]
        request = client.get_request()
        if request in (_REAPURB, _REAPURBNDELAY):
            host.ask(client)
        else:
            error = self._answer(request, client.get_arg(), host) if self._plugged else errno.ENODEV
            client.complete(-1 if error else 0, error)
            self.move()

    @property
    def _begins(self) -> bool:
        return any(host.beginning is not None for host in self._hosts.values())

    def _remove_vanished(self) -> None:
        """Remove hosts that have closed the node, or ended: umockdev reports that only on request."""
        for client, host in list(self._hosts.items()):
            if not client.get_connected():
                del self._hosts[client]
                if self._claimed_by is host:
                    self._claimed_by = None

    def _answer(self, request: int, argument: Any, host: Host) -> int:
        """Return the errno of a system call, 0 for success."""
        if request == _SUBMITURB:
            return self._submit(Urb(argument), host)
        if request == _DISCARDURB:
            where = int.from_bytes(argument.retrieve(), sys.byteorder)
            # Where there is none, it is finished already.
            return 0 if self._hold or host.end(-errno.ENOENT, where) else errno.EINVAL
        if request == _CLAIMINTERFACE:
            if self._claimed_by not in (None, host):
                return errno.EBUSY
            self._claimed_by = host
        elif request == _RELEASEINTERFACE:
            self._claimed_by = None
        elif request == _CLEAR_HALT:
            self._halted = False
        elif request == _GETDRIVER:
            return errno.ENODATA
        elif request == _GET_CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("=I", _CAPABILITIES))
        elif request not in (_SETCONFIGURATION, _SETINTERFACE):
            return errno.ENOTTY
        return 0

    def _submit(self, urb: Urb, host: Host) -> int:
        if urb.type == _URB_CONTROL:
            self._control(urb, host)
        elif self._claimed_by is not host:
            return errno.EBUSY
        elif urb.endpoint == ENDPOINT_IN:
            host.waiting.append(urb)
        elif urb.endpoint == ENDPOINT_OUT:
            host.sending.append((urb, urb.read()))
            self.to_board()
        else:
            return errno.ENOENT
        return 0

    def _control(self, urb: Urb, host: Host) -> None:
        request_type, request, value, _, length = struct.unpack("<BBHHH", urb.read()[:_SETUP_BYTES])
        text = self._strings.get(value & 0xFF)
        if (request_type, request, value) == (*_REQUEST_BEGIN, _PROTOCOL_MAJOR):
            host.beginning = urb
            self._rest = b""
            self._board.send(bytes([BEGIN]))
        elif (request_type, request, value >> 8) == (*_REQUEST_GET_DESCRIPTOR, _DESCRIPTOR_STRING) and text is not None:
            host.finish(urb, 0, (bytes([2 + len(text), _DESCRIPTOR_STRING]) + text)[:length])
        else:
            host.finish(urb, -errno.EPIPE)

    def _end_all(self, status: int) -> None:
        for host in self._hosts.values():
            host.end(status)
        self._rest = b""


class Bus:
    """The bus that the device is plugged into and pulled from, as the board requests."""

    def __init__(self, board: socket.socket, control: socket.socket, serial_number: str) -> None:
        self._board = board
        self._control = control
        self._strings = {0: b"\x09\x04"}
        for index, text in enumerate(("resonatord", "emulated counter board", serial_number), start=1):
            self._strings[index] = text.encode("utf-16-le")
        self._testbed = UMockdev.Testbed.new()
        self._nodes: list[Any] = []  # requests to an earlier one are answered: no device
        self._address = 1
        self._listening = self._waiting_for_room = False
        self._loop = GLib.MainLoop()
        self._plug_in()

    def run(self) -> None:
        """Serve until the board goes."""
        GLib.io_add_watch(self._control.fileno(), GLib.PRIORITY_HIGH, GLib.IO_IN | GLib.IO_HUP, self._on_control)
        self._board.send(bytes([READY]) + self._testbed.get_root_dir().encode())
        self._loop.run()
        shutil.rmtree(self._testbed.get_root_dir(), ignore_errors=True)  # umockdev would leave it

    def _plug_in(self) -> None:
        self._address += 1  # as on a real bus
        self._path = f"/devices/pci0000:00/usb1/1-{self._address}"
        node, descriptors = f"bus/usb/001/{self._address:03d}", device_descriptors().hex().upper()
        self._device = Device(self._board, self._strings)
        handler = UMockdev.IoctlBase()
        handler.connect("handle-ioctl", self._on_ioctl, self._device)
        self._nodes.append(handler)
        self._testbed.attach_ioctl(f"/dev/{node}", handler)  # first: hosts are notified when the device is added
        self._testbed.add_from_string(
            f"P: {self._path}\nN: {node}={descriptors}\n"
            f"E: SUBSYSTEM=usb\nE: DEVTYPE=usb_device\nE: DEVNAME=/dev/{node}\n"
            f"E: BUSNUM=001\nE: DEVNUM={self._address:03d}\n"
            f"A: busnum=1\\n\nA: devnum={self._address}\\n\nA: speed=480\\n\nA: bConfigurationValue=1\\n\n"
            f"H: descriptors={descriptors}\n"
        )

    def _unplug(self) -> None:
        self._device.unplug()
        self._testbed.uevent(f"/sys{self._path}", "remove")
        self._testbed.remove_device(f"/sys{self._path}")

    def _on_ioctl(self, _handler: Any, client: Any, device: Device) -> bool:
        # Called in a thread of umockdev's; all that is done is done in the main loop's.
        GLib.idle_add(self._ioctl, client, device, priority=GLib.PRIORITY_DEFAULT)
        return True  # it will be answered

    def _ioctl(self, client: Any, device: Device) -> bool:
        device.ioctl(client)
        self._watch()
        return False

    def _on_control(self, *_: Any) -> bool:
        message = self._control.recv(_MESSAGE_BYTES_MAX)
        if not message:
            self._loop.quit()
            return False
        device = self._device
        {UNPLUG: self._unplug, PLUG: self._plug_in, STALL: device.stall, HOLD: device.hold}[message[0]]()
        self._watch()
        return True

    def _watch(self) -> None:
        """Read from the board only while the device accepts bytes: the rest waits in the socket."""
        if not self._listening and self._device.takes_data:
            self._listening = True
            GLib.io_add_watch(self._board.fileno(), GLib.PRIORITY_DEFAULT, GLib.IO_IN, self._on_board)
        if not self._waiting_for_room and self._device.has_data:
            self._waiting_for_room = True
            GLib.io_add_watch(self._board.fileno(), GLib.PRIORITY_DEFAULT, GLib.IO_OUT, self._on_room)

    def _on_board(self, *_: Any) -> bool:
        while self._device.takes_data:
            try:
                message = self._board.recv(_MESSAGE_BYTES_MAX)
            except BlockingIOError:
                break
            if message[:1] == bytes([DATA]):
                self._device.from_board(message[1:])
            elif message[:1] == bytes([BEGUN]):
                self._device.begun()
            else:
                self._loop.quit()  # the board has gone
                return False
        self._device.move()
        self._listening = self._device.takes_data
        return self._listening

    def _on_room(self, *_: Any) -> bool:
        self._device.to_board()
        self._waiting_for_room = self._device.has_data
        return self._waiting_for_room


def main() -> None:
    board, control = (socket.socket(fileno=int(number)) for number in sys.argv[1:3])
    board.setblocking(False)
    Bus(board, control, sys.argv[3]).run()


if __name__ == "__main__":
    main()
