"""The STM32 board program, built by its CMake project with warnings as errors: its vectors, its memory."""

import json
import socket
import struct
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
import qemu_board
from firmware_wire_host import ASK_AGAIN_S
from listener import DEADLINE_S

from firmware_protocol.layouts import MessageType
from firmware_protocol.packets import encode_packet

pytestmark = pytest.mark.firmware

SOURCES = qemu_board.SOURCES.parent / "stm32f4"
FLASH_BYTES, RAM_BYTES = 1 << 20, 128 << 10
USART3_INTERRUPT = 39


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stm32f4")
    toolchain = f"-DCMAKE_TOOLCHAIN_FILE={SOURCES / 'arm-none-eabi.cmake'}"
    for command in (["cmake", "-S", str(SOURCES), "-B", str(folder), toolchain], ["cmake", "--build", str(folder)]):
        made = subprocess.run(command, capture_output=True, text=True, check=False)
        assert made.returncode == 0, made.stdout[-4000:] + made.stderr[-4000:]
    return folder


def test_the_image_begins_with_the_vectors_of_the_chip(folder: Path) -> None:
    image = (folder / "resonator_stm32f4.bin").read_bytes()
    stack, reset = struct.unpack_from("<2I", image)
    (receive,) = struct.unpack_from("<I", image, 4 * (16 + USART3_INTERRUPT))
    assert stack == 0x20000000 + RAM_BYTES
    for handler in (reset, receive):
        assert handler & 1  # Thumb
        assert 0x08000000 + 4 * (16 + 82) <= handler < 0x08000000 + len(image)
    assert reset != receive


def test_it_fits(folder: Path) -> None:
    elf = str(folder / "resonator_stm32f4.elf")
    printed = subprocess.run(["arm-none-eabi-size", elf], capture_output=True, text=True, check=True).stdout
    text_bytes, data_bytes, bss_bytes = map(int, printed.splitlines()[1].split()[:3])
    assert text_bytes + data_bytes < FLASH_BYTES // 16
    assert data_bytes + bss_bytes < RAM_BYTES - 8192


ACCEPTED = """
#include <stddef.h>
#include "resonator_board.h"
char offset[offsetof(struct resonator_board, decoder.counts.accepted)];
"""


def symbol(path: Path, name: str) -> tuple[int, int]:
    """Return the address and the size of a variable."""
    printed = subprocess.run(["arm-none-eabi-nm", "-S", str(path)], capture_output=True, text=True, check=True).stdout
    address, size = next(line.split()[:2] for line in printed.splitlines() if line.endswith(f" {name}"))
    return int(address, 16), int(size, 16)


def test_it_starts_and_accepts_requests_on_an_emulated_stm32f405(folder: Path, tmp_path: Path) -> None:
    """QEMU has its core, timer and serial lines, but neither its clocks nor DMA: what the board sends stays inside."""
    (tmp_path / "accepted.c").write_text(ACCEPTED)
    compiler = ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", f"-I{SOURCES.parent}", "-c", "accepted.c"]
    subprocess.run(compiler, cwd=tmp_path, check=True)
    elf = folder / "resonator_stm32f4.elf"
    accepted = symbol(elf, "board")[0] + symbol(tmp_path / "accepted.o", "offset")[1]
    port = qemu_board.free_port()
    serial = ["-serial", "null", "-serial", "null", "-serial", f"tcp:127.0.0.1:{port},server=on,wait=off"]
    command = [
        "qemu-system-arm", "-M", "netduinoplus2", "-kernel", str(elf), "-display", "none", "-qmp", "stdio", *serial
    ]  # fmt: skip
    requests = encode_packet(MessageType.IDENTIFY, 1) + encode_packet(MessageType.PING, 2, b"12345678")
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as board:
        try:
            ask(board)  # the greeting: the port is open by then
            ask(board, "qmp_capabilities")
            with socket.create_connection(("127.0.0.1", port)) as host:
                begun = asked = time.monotonic()
                host.sendall(requests)
                while (count := word(board, accepted)) < len(requests):
                    now = time.monotonic()
                    assert now < begun + DEADLINE_S, f"{count} bytes were accepted"
                    if now > asked + ASK_AGAIN_S:  # what came before the line was open is lost
                        host.sendall(requests)
                        asked = now
        finally:
            board.kill()


def ask(board: subprocess.Popen[str], execute: str | None = None, **arguments: str) -> Any:
    """Send a command of QEMU's machine protocol, if there is one; return the next answer."""
    assert board.stdin is not None
    assert board.stdout is not None
    if execute is not None:
        board.stdin.write(json.dumps({"execute": execute, "arguments": arguments}) + "\n")
        board.stdin.flush()
    while "event" in (answer := json.loads(board.stdout.readline())):
        pass
    return answer.get("return")


def word(board: subprocess.Popen[str], address: int) -> int:
    printed = ask(board, "human-monitor-command", **{"command-line": f"xp /1xw {address:#x}"})
    return int(printed.split()[-1], 16)
