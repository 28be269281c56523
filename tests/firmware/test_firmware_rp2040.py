"""The RP2040 board program, compiled against the Pico SDK, and its USB part against TinyUSB's prototypes."""

import os
import re
import subprocess
from pathlib import Path

import pytest
import qemu_board

pytestmark = pytest.mark.firmware

SOURCES = qemu_board.SOURCES.parent / "rp2040"
FETCHED_SDK = Path(__file__).parents[2] / "build" / "pico-sdk"
TINYUSB = Path(__file__).parent / "tinyusb"


def carry_out(command: list[str], **environment: str) -> str:
    made = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | environment)
    assert made.returncode == 0, made.stdout[-4000:] + made.stderr[-4000:]
    return made.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Configure the board program with its link over UART, for which the SDK alone is enough."""
    sdk = Path(os.environ.get("PICO_SDK_PATH", FETCHED_SDK))
    if not (sdk / "pico_sdk_init.cmake").exists():
        pytest.skip("no Pico SDK: set PICO_SDK_PATH, or let make test-firmware fetch it")
    folder = tmp_path_factory.mktemp("rp2040")
    options = ["-DRESONATOR_LINK=uart", "-DPICO_NO_PICOTOOL=1"]
    carry_out(
        ["cmake", "-G", "Unix Makefiles", "-S", str(SOURCES), "-B", str(folder), *options], PICO_SDK_PATH=str(sdk)
    )
    carry_out(["cmake", "--build", str(folder), "--target", "resonator_rp2040_capture_pio_h"])
    return folder


def test_it_compiles_against_the_sdk_without_a_warning(folder: Path) -> None:
    carry_out(["make", "-C", str(folder), "main.o", "capture.o", "uart_link.o"])


def test_it_links_where_the_compiler_has_its_c_plus_plus_library(folder: Path) -> None:
    """The SDK has sources in C++; Debian's libstdc++ for this compiler takes 1.6 GB and is not installed for it."""
    probe = ["arm-none-eabi-g++", "-fsyntax-only", "-x", "c++", "-"]
    if subprocess.run(probe, input="#include <cassert>\n", capture_output=True, text=True, check=False).returncode:
        pytest.skip("no C++ library for arm-none-eabi (libstdc++-arm-none-eabi-newlib)")
    carry_out(["cmake", "--build", str(folder)])
    printed = carry_out(["arm-none-eabi-size", str(folder / "resonator_rp2040.elf")])
    text_bytes, data_bytes, bss_bytes = map(int, printed.splitlines()[1].split()[:3])
    assert text_bytes < 1 << 20
    assert data_bytes + bss_bytes < 200 << 10


def test_the_assembler_makes_the_program_that_is_simulated(folder: Path) -> None:
    """The words by the RP2040 data sheet: jmp y-- 4 [1], mov isr x, push noblock, mov y osr [1], then the two loops."""
    header = (folder / "capture.pio.h").read_text()
    words = [int(word, 16) for word in re.findall(r"^\s+0x([0-9a-f]{4}),", header, flags=re.MULTILINE)]
    assert words == [0x0184, 0xA0C1, 0x8000, 0xA147, 0x0045, 0x00C4, 0x0047, 0x00C0]
    assert re.search(r"capture_wrap_target 6\b", header)
    assert re.search(r"capture_wrap 7\b", header)


@pytest.mark.parametrize("source", ["usb_link.c", "usb_descriptors.c"])
def test_the_usb_part_compiles_against_the_prototypes_of_tinyusb(source: str, tmp_path: Path) -> None:
    options = [
        "-mcpu=cortex-m0plus", "-mthumb", "-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"
    ]  # fmt: skip
    folders = [f"-I{TINYUSB}", f"-I{SOURCES}", f"-I{SOURCES.parent}"]
    carry_out(["arm-none-eabi-gcc", *options, *folders, "-c", str(SOURCES / source), "-o", str(tmp_path / "object.o")])
