"""Finding boards on USB buses, where pyusb fails; what is found on a bus is in test_usb_link.py."""

from collections.abc import Iterator

import pytest

from resonator_daemon.board.links import usb_devices
from resonator_daemon.board.links.usb_devices import present_boards

UNSUPPORTED = "Operation not supported or unimplemented on this platform"


def test_a_device_that_shows_no_descriptors_hides_no_board(monkeypatch: pytest.MonkeyPatch) -> None:
    class Backend:
        def enumerate_devices(self) -> Iterator[object]:
            return iter(["strange"])

        def get_device_descriptor(self, device: object) -> object:
            raise NotImplementedError(UNSUPPORTED)

    monkeypatch.setattr(usb_devices, "usb_backend", Backend)
    assert present_boards() == []
