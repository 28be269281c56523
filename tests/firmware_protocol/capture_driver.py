"""The files of `c/common`, built with sanitizers and driven by lines of text (c/tests/capture_driver.c)."""

import subprocess
import tempfile
from functools import cache
from pathlib import Path

from c_reference import C_FOLDER, build, reference_sources

SOURCES = [str(C_FOLDER / "tests" / "capture_driver.c"), *map(str, sorted((C_FOLDER / "common").glob("*.c")))]


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="resonator-capture-")


@cache
def _driver() -> Path:
    return build(Path(_folder().name) / "driver", *SOURCES, *reference_sources())


def run_captures(commands: list[str]) -> list[str]:
    """Return what the driver printed; a sanitizer's report is a failure."""
    text = "\n".join(commands) + "\n"
    done = subprocess.run([_driver()], input=text, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout.splitlines()
