"""The cache of set-ups: same dependencies, same file; whatever is wrong with it only costs the time to build."""

import logging
import os
from pathlib import Path

import numpy as np
import pytest

from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoder_setup import cached
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where set-ups are kept; made by the first of them."""
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "kept"))
    return tmp_path / "kept"


class Builder:
    """Counts how often it built."""

    def __init__(self) -> None:
        self.built = 0

    def __call__(self) -> int:
        self.built += 1
        return 100 + self.built


def depends_on(*, gain_std: float = 0.0, contact_physics: bool = True, noise: float = 1e-3) -> object:
    sites_m = 4e-4 * np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), axis=-1).reshape(-1, 2)
    return (
        Skin(HalfSpace(2e5, 0.5), sites_m, 1e-3, gain_std),
        DecodingOptions(contact_physics=contact_physics),
        np.array([noise]),
    )


def test_what_was_built_once_is_found_again(directory: Path) -> None:
    build = Builder()
    assert [cached(depends_on(), build) for _ in range(3)] == [101, 101, 101]
    (file,) = directory.iterdir()  # and no half-written one next to it
    assert file.suffix == ".pickle"
    assert directory.stat().st_mode & 0o77 == 0  # what is unpickled must be the user's own


@pytest.mark.parametrize("changed", [{"gain_std": 0.01}, {"contact_physics": False}, {"noise": 1.03e-3}])
def test_anything_else_is_built(directory: Path, changed: dict[str, float]) -> None:
    build = Builder()
    assert cached(depends_on(), build) == 101
    assert cached(depends_on(**changed), build) == 102
    assert cached(depends_on(), build) == 101


@pytest.mark.parametrize("damage", [0, 3, 0.3, 0.9], ids=["empty", "cut", "a bit early", "a bit late"])
def test_a_damaged_file_is_replaced_and_logged(
    directory: Path, damage: float, caplog: pytest.LogCaptureFixture
) -> None:
    """A flipped bit in an array leaves a pickle that can be read."""
    cached("key", lambda: np.arange(1000.0))
    (file,) = directory.iterdir()
    content = bytearray(file.read_bytes())
    if isinstance(damage, int):
        del content[damage:]
    else:
        content[int(damage * len(content))] ^= 1
    file.write_bytes(content)
    for _ in range(2):
        np.testing.assert_array_equal(cached("key", lambda: np.arange(1000.0)), np.arange(1000.0))
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


def test_where_nothing_can_be_kept_it_is_built_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "file"))
    build = Builder()
    assert [cached("key", build) for _ in range(2)] == [101, 102]
    assert "not cached" in caplog.text
    assert "Errno" not in caplog.text


def test_the_four_that_were_used_last_are_kept(directory: Path) -> None:
    build = Builder()
    files: dict[int, Path] = {}
    for number in range(4):
        cached(number, build)
        (files[number],) = set(directory.iterdir()) - set(files.values())
        os.utime(files[number], (1e9 + number, 1e9 + number))
    assert cached(0, build) == 101  # oldest, but used now
    cached(4, build)
    assert build.built == 5
    kept = set(directory.iterdir())
    assert len(kept) == 4
    assert kept > {files[0], files[2], files[3]}


def test_what_a_killed_program_left_is_removed_and_what_is_being_written_stays(directory: Path) -> None:
    directory.mkdir()
    left, fresh = directory / "left.part", directory / "fresh.part"
    for part in (left, fresh):
        part.write_bytes(b"half")
    os.utime(left, (1.0, 1.0))
    cached("one", Builder())
    assert not left.exists()
    assert fresh.exists()
