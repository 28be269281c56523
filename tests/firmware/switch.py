"""A board that can be switched on and off, as fixtures hand it to tests."""

from typing import NamedTuple

import qemu_board

from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.carriers.tcp import TcpTarget


class Switch(NamedTuple):
    """A board that can be switched on and off, and the daemon's name for its port."""

    board: qemu_board.QemuBoard
    link: SerialTarget | TcpTarget
