"""Several bulk-in transfers in flight at once, in order: what libusb can and pyusb leaves out.

pyusb reads one transfer at a time. Between two of them the host asks the device for nothing, and the device's own
memory must hold what it counts meanwhile. Here the kernel always has the next transfers at hand. The library is the one
that pyusb has loaded, called through ctypes; `libusb_transfer` has had this layout in every release of libusb 1.0.
"""

import ctypes
import time
from collections import deque
from enum import IntEnum
from typing import Any

TRANSFERS = 8
TRANSFER_BYTES = 16384  # a multiple of every bulk packet size, so that no packet overflows a transfer

_TYPE_BULK = 2
_ERROR_NO_DEVICE = -4
_ERROR_INTERRUPTED = -10


class Failure(IntEnum):
    """Causes of the end of transfers that were not cancelled; numbers of `libusb_transfer_status`."""

    ERROR = 1
    TIMED_OUT = 2
    STALL = 4
    NO_DEVICE = 5
    OVERFLOW = 6


_COMPLETED, _CANCELLED = 0, 3


class _Transfer(ctypes.Structure):
    pass


_TransferPointer = ctypes.POINTER(_Transfer)
_Callback = ctypes.CFUNCTYPE(None, _TransferPointer)
_Transfer._fields_ = [
    ("dev_handle", ctypes.c_void_p),
    ("flags", ctypes.c_uint8),
    ("endpoint", ctypes.c_ubyte),
    ("type", ctypes.c_ubyte),
    ("timeout", ctypes.c_uint),
    ("status", ctypes.c_int),
    ("length", ctypes.c_int),
    ("actual_length", ctypes.c_int),
    ("callback", _Callback),
    ("user_data", ctypes.c_void_p),
    ("buffer", ctypes.c_void_p),
    ("num_iso_packets", ctypes.c_int),
]


class _TimeValue(ctypes.Structure):
    _fields_ = [("seconds", ctypes.c_long), ("microseconds", ctypes.c_long)]


class _Library:
    """The functions of libusb that are needed, with types of their own: pyusb's stay as pyusb has set them."""

    def __init__(self, library: Any) -> None:
        def function(name: str, result: Any, *arguments: Any) -> Any:
            return ctypes.CFUNCTYPE(result, *arguments)((name, library))

        self.alloc_transfer = function("libusb_alloc_transfer", _TransferPointer, ctypes.c_int)
        self.free_transfer = function("libusb_free_transfer", None, _TransferPointer)
        self.submit_transfer = function("libusb_submit_transfer", ctypes.c_int, _TransferPointer)
        self.cancel_transfer = function("libusb_cancel_transfer", ctypes.c_int, _TransferPointer)
        self.handle_events = function(
            "libusb_handle_events_timeout_completed",
            ctypes.c_int,
            ctypes.c_void_p,
            ctypes.POINTER(_TimeValue),
            ctypes.c_void_p,
        )


_left_behind: list["BulkReader"] = []  # that the kernel may still write to


class BulkReader:
    """Keeps transfers from one bulk-in endpoint in flight while it is started; of one thread.

    Nothing is received but within `wait`, and within synchronous transfers on the same context: what has been received
    and not taken is bounded by what libusb handles at a time, 25 transfers.

    Parameters
    ----------
    backend
        pyusb's backend over libusb 1.0.
    handle
        An open device of that backend, its interface claimed; must stay open until `close` has returned True.
    endpoint
        Address of the bulk-in endpoint.

    Attributes
    ----------
    failure
        Why transfers have ended since `start`; what was received before is still to be taken.
    """

    def __init__(self, backend: Any, handle: Any, endpoint: int) -> None:
        self._library = _Library(backend.lib)
        self._context = backend.ctx
        self._received: deque[bytes] = deque()
        self._in_flight = 0
        self._started = False
        self.failure: Failure | None = None
        self._callback = _Callback(self._ended)  # must live as long as the transfers
        self._buffers = [ctypes.create_string_buffer(TRANSFER_BYTES) for _ in range(TRANSFERS)]
        self._transfers = []
        for buffer in self._buffers:
            pointer = self._library.alloc_transfer(0)
            if not pointer:
                raise MemoryError("libusb has no memory for a transfer")
            transfer = pointer.contents
            transfer.dev_handle = handle.handle
            transfer.endpoint = endpoint
            transfer.type = _TYPE_BULK
            transfer.length = TRANSFER_BYTES
            transfer.buffer = ctypes.addressof(buffer)
            transfer.callback = self._callback
            self._transfers.append(pointer)

    def start(self) -> None:
        """Put all transfers in flight; none may be."""
        self.failure = None
        self._started = True
        for pointer in self._transfers:
            self._submit(pointer)

    def wait(self, timeout_s: float) -> None:
        """Handle events of the library for at most `timeout_s`; return early once one was handled."""
        seconds, rest_s = divmod(max(timeout_s, 0.0), 1.0)
        interval = _TimeValue(int(seconds), int(rest_s * 1e6))
        code = self._library.handle_events(self._context, ctypes.byref(interval), None)
        if code < 0 and code != _ERROR_INTERRUPTED:
            self._fail(Failure.ERROR)

    def pop_received(self) -> bytes:
        """Return what has been received, in order."""
        data = b"".join(self._received)
        self._received.clear()
        return data

    def stop(self, timeout_s: float) -> bool:
        """Cancel all transfers and wait for their end; return whether all have ended in time."""
        self._started = False
        # The one that is being filled goes last, so that none restarts. For the order of data either way would do:
        # usbfs has ended a transfer when this returns, and hands transfers back in the order of their ends.
        for pointer in reversed(self._transfers):
            self._library.cancel_transfer(pointer)
        deadline = time.monotonic() + timeout_s
        while self._in_flight and (left_s := deadline - time.monotonic()) > 0.0:
            self.wait(left_s)
        return self._in_flight == 0

    def close(self, timeout_s: float) -> bool:
        """End all transfers; False where some would not end: their memory is left behind, and so must the handle be."""
        if not self.stop(timeout_s):
            _left_behind.append(self)
            return False
        while self._transfers:
            self._library.free_transfer(self._transfers.pop())
        return True

    def _submit(self, pointer: Any) -> None:
        code = self._library.submit_transfer(pointer)
        if code == 0:
            self._in_flight += 1
        else:
            self._fail(Failure.NO_DEVICE if code == _ERROR_NO_DEVICE else Failure.ERROR)

    def _ended(self, pointer: Any) -> None:
        """Handle an ended transfer; called by libusb, which loses exceptions."""
        self._in_flight -= 1
        transfer = pointer.contents
        if transfer.actual_length > 0:  # also of those that failed or were cancelled half way
            self._received.append(ctypes.string_at(transfer.buffer, transfer.actual_length))
        if transfer.status not in (_COMPLETED, _CANCELLED):
            self._fail(Failure(transfer.status))
        elif self._started and self.failure is None:
            self._submit(pointer)

    def _fail(self, failure: Failure) -> None:
        self.failure = self.failure or failure
