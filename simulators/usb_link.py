"""A USB link of an emulated board: a device for programs that are started with umockdev's library preloaded."""

import os
import socket
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

from resonator_daemon.base.errors import UserError

SYSTEM_PYTHON = "/usr/bin/python3"
_GADGET = Path(__file__).with_name("usb_gadget.py")
_PRELOAD = "libumockdev-preload.so.0"
_INSTALL = "apt-get install umockdev gir1.2-umockdev-1.0 python3-gi libusb-1.0-0"
_START_S = 10.0
_STOP_S = 2.0
_CHUNK_BYTES = 16384
_SEND_BUFFER_BYTES = 65536  # as of a device's own memory: what is beyond waits in the board's queue
_MESSAGE_BYTES_MAX = 1 + 65536

# As in usb_gadget.py, which no other Python than the system's can import: its ids, and the first byte of a message.
_VENDOR_ID, _PRODUCT_ID = 0x1209, 0x0001
_DATA, _BEGIN, _BEGUN, _READY = (b"%c" % kind for kind in b"dBbr")
_UNPLUG, _PLUG, _STALL, _HOLD = (b"%c" % kind for kind in b"uxsh")


class UsbLink:
    """A USB device; its other half is `usb_gadget.py`, a child process under the system's Python.

    Parameters
    ----------
    serial_number
        Of the device's string descriptor.
    on_begin
        Called within `read` when a host begins again: the board goes idle and discards its output. What was written
        before it returns reaches no host.

    Raises
    ------
    UserError
        umockdev, or the system's Python with its bindings, is missing.
    """

    def __init__(self, serial_number: str, on_begin: Callable[[], None]) -> None:
        self._serial_number = serial_number
        self._on_begin = on_begin
        self._plugged = True
        self._board, board_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control, control_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._board.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process; a pipe would fill and block it
        with board_end, control_end:
            fds = (board_end.fileno(), control_end.fileno())
            # Preloaded as well: udev events are sent by way of the emulated /sys.
            environment = {**os.environ, "LD_PRELOAD": _PRELOAD}
            environment.pop("PYTHONPATH", None)
            try:
                self._process = subprocess.Popen(
                    [SYSTEM_PYTHON, "-s", str(_GADGET), *map(str, fds), serial_number],
                    pass_fds=fds,
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stderr=self._stderr,
                    start_new_session=True,  # Ctrl-C is for the emulator, which ends it
                )
            except OSError as error:
                self._close_files()
                raise UserError(f"{SYSTEM_PYTHON} cannot be started ({error.strerror}); {_INSTALL}") from error
        self.environment = {"LD_PRELOAD": _PRELOAD, "UMOCKDEV_DIR": self._wait_until_ready()}
        self._board.setblocking(False)

    @property
    def address(self) -> str:
        return f"usb:{_VENDOR_ID:04x}:{_PRODUCT_ID:04x}?serial={self._serial_number}"

    @property
    def read_fds(self) -> list[int]:
        return [self._board.fileno()]

    @property
    def write_fd(self) -> int | None:
        return self._board.fileno() if self._plugged else None

    def read(self) -> bytes:
        try:
            message = self._board.recv(_MESSAGE_BYTES_MAX)
        except BlockingIOError:
            return b""
        if not message:
            raise OSError("the USB side of the emulated board has ended")
        if message[:1] == _BEGIN:
            self._on_begin()
            self._board.setblocking(True)  # the device discards what came earlier, so there is room
            self._board.send(_BEGUN)
            self._board.setblocking(False)
        return message[1:] if message[:1] == _DATA and self._plugged else b""

    def write(self, data: bytes | memoryview) -> int:
        if not self._plugged:
            return 0
        chunk = data[:_CHUNK_BYTES]
        try:
            self._board.send(_DATA + bytes(chunk))
        except BlockingIOError:
            return 0
        return len(chunk)

    def hang_up(self) -> None:
        if self._plugged:
            self._control.send(_UNPLUG)
            self._plugged = False

    def plug_in(self) -> None:
        if not self._plugged:
            self._control.send(_PLUG)
            self._plugged = True

    def stall(self) -> None:
        """Answer the host's next transfer with a stall."""
        self._control.send(_STALL)

    def hold_cancelled(self) -> None:
        """Never give back a transfer that the host cancels, as a driver that hangs."""
        self._control.send(_HOLD)

    def close(self) -> None:
        self._close_files()  # which ends the device
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait_until_ready(self) -> str:
        """Return the directory of the emulated /sys and /dev."""
        self._board.settimeout(_START_S)
        try:
            message = self._board.recv(_MESSAGE_BYTES_MAX)
        except (TimeoutError, ConnectionError):
            message = b""
        if message[:1] == _READY:
            return message[1:].decode()
        self._process.kill()
        self._process.wait()
        self._stderr.seek(0)
        text = self._stderr.read()
        self._close_files()
        reason = text.decode(errors="replace").strip().rpartition("\n")[2] or f"it did not start within {_START_S:g} s"
        raise UserError(f"no USB device can be emulated: {reason}; {_INSTALL}")

    def _close_files(self) -> None:
        for file in (self._board, self._control, self._stderr):
            file.close()
