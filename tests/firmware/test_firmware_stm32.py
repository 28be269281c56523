"""The STM32 board program, built by its CMake project with warnings as errors: its vectors, its memory."""

import struct
import subprocess
from pathlib import Path

import pytest
import qemu_board

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
