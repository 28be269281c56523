"""Limited space for files: a small file system, and a limit of the process."""

import os
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


@contextmanager
def small_disk(folder: Path, size_bytes: int) -> Iterator[tuple[Path, Callable[[], None], Callable[[], None]]]:
    """Mount a disk in memory; yields its path, what fills it to the last byte, and what frees that again."""
    disk = folder / "disk"
    disk.mkdir()
    mount = shutil.which("mount") or "/bin/mount"
    command = [mount, "-t", "tmpfs", "-o", f"size={size_bytes}", "tmpfs", str(disk)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mounting needs root")
    filler = disk / "filler"

    def fill() -> None:
        with open(filler, "wb", buffering=0) as file:
            for block in (65536, 4096, 1):
                with suppress(OSError):
                    while True:
                        file.write(b"\0" * block)
        assert os.statvfs(disk).f_bavail == 0

    try:
        yield disk, fill, lambda: filler.unlink(missing_ok=True)
    finally:
        subprocess.run([shutil.which("umount") or "/bin/umount", "-l", str(disk)], check=True)


@contextmanager
def file_size_limit(size_bytes: int) -> Iterator[None]:
    """Limit the files that this process writes; beyond, a write fails with EFBIG."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
