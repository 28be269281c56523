"""A board that can be switched on and off, as fixtures hand it to tests."""

from typing import NamedTuple

import qemu_board

from resonator_daemon.config import SerialLink, TcpLink


class Switch(NamedTuple):
    """A board that can be switched on and off, and the daemon's name for its port."""

    board: qemu_board.QemuBoard
    link: SerialLink | TcpLink
