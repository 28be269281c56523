"""The board program, built once, and a board that runs it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import qemu_board
from switch import Switch

from resonator_daemon.board.links.carriers.serial import SerialTarget
from resonator_daemon.board.links.carriers.tcp import TcpTarget


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return qemu_board.build(tmp_path_factory.mktemp("mps2_an385"))


@pytest.fixture(params=["tcp", "pty"])
def switch(request: pytest.FixtureRequest, program: Path, tmp_path: Path) -> Iterator[Switch]:
    """Switch a board on, on either kind of port."""
    if request.param == "tcp":
        port = qemu_board.free_port()
        board = qemu_board.QemuBoard(program, tcp_port=port)
        link: SerialTarget | TcpTarget = TcpTarget("127.0.0.1", port)
    else:
        board = qemu_board.QemuBoard(program, pty=tmp_path / "board")
        link = SerialTarget(str(tmp_path / "board"), 4_000_000)
    with board:
        yield Switch(board, link)
