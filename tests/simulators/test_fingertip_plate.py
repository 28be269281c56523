"""The third plate: its file is what its script makes."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_file_is_what_its_script_makes() -> None:
    run = subprocess.run([sys.executable, ROOT / "docs/plates/fingertip400.py"], capture_output=True, check=True)
    assert run.stdout == (ROOT / "resonator_daemon/base/plates/fingertip400.toml").read_bytes()
