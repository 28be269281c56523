"""What the C reference promises of itself: small, nothing from libc, sound under random inputs."""

import re
import subprocess
from pathlib import Path
from shutil import which

import pytest
from c_reference import C_FOLDER, WARNINGS, build, compiler, reference_sources

FLASH_LIMIT_BYTES = 8192
FIRMWARE = (
    "-Os", "-ffreestanding", "-fno-tree-loop-distribute-patterns", "-fno-asynchronous-unwind-tables", "-fno-pie"
)  # fmt: skip
CORTEX_M3 = ("arm-none-eabi-", ("-mcpu=cortex-m3", "-mthumb"))
CORTEX_M0 = ("arm-none-eabi-", ("-mcpu=cortex-m0plus", "-mthumb"))
# The cross compiler is not needed for these tests: `make test-firmware` brings it.
TARGETS = [("", ())] + ([CORTEX_M3, CORTEX_M0] if which("arm-none-eabi-gcc") else [])


@pytest.mark.parametrize(("prefix", "machine"), TARGETS)
def test_fits_8_kib_and_needs_nothing_from_libc(prefix: str, machine: tuple[str, ...], tmp_path: Path) -> None:
    command = [f"{prefix}gcc" if prefix else compiler(), *WARNINGS, *FIRMWARE, *machine, "-c", *reference_sources()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    objects = sorted(map(str, tmp_path.glob("*.o")))
    size = subprocess.run([f"{prefix}size", "--totals", *objects], capture_output=True, text=True, check=True).stdout
    text_bytes, data_bytes, bss_bytes = map(int, size.splitlines()[-1].split()[:3])
    assert 2000 < text_bytes <= FLASH_LIMIT_BYTES
    assert data_bytes == bss_bytes == 0, "the reference keeps no state of its own"
    symbols = subprocess.run([f"{prefix}nm", "--undefined-only", *objects], capture_output=True, text=True, check=True)
    outside = set(re.findall(r" U (\S+)", symbols.stdout))
    from_libc = {name for name in outside if not name.startswith(("resonator_", "__aeabi_", "__gnu_thumb1_"))}
    assert from_libc <= {"memcpy"}


def test_random_inputs_in_c(tmp_path: Path) -> None:
    fuzz = build(tmp_path / "fuzz", *reference_sources(), str(C_FOLDER / "fuzz" / "fuzz.c"))
    done = subprocess.run([fuzz, "100000", "1"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"accepted [1-9].*discarded [1-9].*damages [1-9]", done.stdout)
    assert re.search(r"runs [1-9].*dropped: frames [1-9].*answers [1-9]", done.stdout)
