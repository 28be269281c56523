"""The cache of set-ups: same dependencies, same file; whatever is wrong with it only costs the time to build."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from resonator_daemon import decoding, elastic
from resonator_daemon.decoding import setup_cache
from resonator_daemon.decoding.setup_cache import cached
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.elastic import HalfSpace


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
    (file,) = directory.iterdir()  # and no half-written one beside it
    assert file.suffix == ".pickle"
    assert directory.stat().st_mode & 0o77 == 0  # what is unpickled must be the user's own


@pytest.mark.parametrize("changed", [{"gain_std": 0.01}, {"contact_physics": False}, {"noise": 1.03e-3}])
def test_anything_else_is_built(directory: Path, changed: dict[str, float]) -> None:
    build = Builder()
    assert cached(depends_on(), build) == 101
    assert cached(depends_on(**changed), build) == 102
    assert cached(depends_on(), build) == 101


def test_other_code_and_other_libraries_build_anew(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert set(setup_cache._CODE) == {Path(room.__path__[0]) for room in (decoding, elastic)}
    source = tmp_path / "code" / "decoder.py"
    source.parent.mkdir()
    source.write_text("a = 1\n")
    monkeypatch.setattr(setup_cache, "_CODE", (source.parent,))
    build = Builder()
    cached("key", build)
    source.write_text("a = 2\n")
    assert cached("key", build) == 102
    monkeypatch.setattr(np, "__version__", "0.1")
    assert cached("key", build) == 103
    monkeypatch.undo()


def test_another_process_finds_it(directory: Path) -> None:
    """Strings and sets hash anew in each process; the name of the file must not."""
    assert cached(depends_on(), Builder()) == 101
    code = "from test_setup_cache import *; print(cached(depends_on(), lambda: 0))"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(Path(__file__).parent)])}
    environment["PYTHONHASHSEED"] = "7"
    said = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert said == "101\n"


@pytest.mark.parametrize("damage", [b"", b"abc", b"not a pickle", b"\x80\x05cnowhere\nNothing\n."])
def test_a_damaged_file_is_replaced_and_said(directory: Path, damage: bytes, caplog: pytest.LogCaptureFixture) -> None:
    build = Builder()
    cached("key", build)
    (file,) = directory.iterdir()
    file.write_bytes(damage)
    assert cached("key", build) == 102
    (warning,) = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert str(file) in warning.getMessage()
    assert cached("key", build) == 102  # mended


@pytest.mark.parametrize("place", [0.3, 0.6, 0.9])
def test_a_number_that_is_damaged_is_found(directory: Path, place: float) -> None:
    """A flipped bit in an array leaves a pickle that can be read."""
    cached("key", lambda: np.arange(1000.0))
    (file,) = directory.iterdir()
    content = bytearray(file.read_bytes())
    content[int(place * len(content))] ^= 1
    file.write_bytes(content)
    assert cached("key", lambda: np.arange(1000.0)) == pytest.approx(np.arange(1000.0), abs=0)


def test_where_nothing_can_be_kept_it_is_built_each_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "file"))
    build = Builder()
    assert [cached("key", build) for _ in range(2)] == [101, 102]


def test_a_directory_that_may_only_be_read_still_serves(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    build = Builder()
    cached("key", build)

    def refused(_: Path) -> None:
        raise PermissionError(30, "read-only file system")

    monkeypatch.setattr(Path, "touch", refused)
    assert cached("key", build) == 101


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


def test_an_interrupted_write_leaves_nothing(directory: Path) -> None:
    cached("key", Builder())
    with pytest.raises(TypeError):
        cached("other", lambda: (n for n in range(3)))  # cannot be pickled: the programmer's mistake
    assert len(list(directory.iterdir())) == 1


@pytest.mark.parametrize(
    ("systemd", "xdg", "home", "expected"),
    [
        ("/a:/b", "/x", "/h", "/a"),
        (None, "/x", "/h", "/x/resonatord"),
        ("", "", "/h", "/h/.cache/resonatord"),
        (None, "relative", "/h", "/h/.cache/resonatord"),
        (None, None, "/h", "/h/.cache/resonatord"),
    ],
)
def test_the_directory_is_systemds_else_that_of_xdg(
    systemd: str | None, xdg: str | None, home: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("CACHE_DIRECTORY", systemd), ("XDG_CACHE_HOME", xdg), ("HOME", home)):
        monkeypatch.delenv(name, raising=False)
        if value is not None:
            monkeypatch.setenv(name, value)
    assert setup_cache._directory() == Path(expected)


def test_no_test_writes_into_the_real_home() -> None:
    assert Path.home() not in setup_cache._directory().parents


def test_what_a_killed_program_left_is_removed_and_what_is_being_written_stays(directory: Path) -> None:
    directory.mkdir()
    left, fresh = directory / "left.part", directory / "fresh.part"
    for part in (left, fresh):
        part.write_bytes(b"half")
    os.utime(left, (1.0, 1.0))
    cached("one", Builder())
    assert not left.exists()
    assert fresh.exists()
