"""What the C reference takes on a Cortex-M3."""

import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.firmware

FLASH_LIMIT_BYTES = 8192


def test_the_reference_fits_in_eight_kibibytes_of_flash(program: Path) -> None:
    objects = sorted(str(path) for path in program.parent.glob("resonator_*.o"))
    assert objects
    said = subprocess.run(["arm-none-eabi-size", *objects], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in said.splitlines()[1:]]
    assert sum(int(text) + int(data) for text, data, *_ in rows) <= FLASH_LIMIT_BYTES
    assert sum(int(bss) for _, _, bss, *_ in rows) == 0  # the caller places everything
