"""Directories by the environment's word, and files that are complete or absent."""

import os
import stat
from pathlib import Path

import pytest

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.host import files


@pytest.fixture(autouse=True)
def _nothing_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR", "STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_state_is_where_systemd_says_else_at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/robot")
    assert files.state_directory() == Path("/home/robot/.local/state/resonatord")
    monkeypatch.setenv("XDG_STATE_HOME", "not/absolute")
    assert files.state_directory() == Path("/home/robot/.local/state/resonatord")
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    assert files.state_directory() == Path("/state/resonatord")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/resonatord:/var/lib/other")
    assert files.state_directory() == Path("/var/lib/resonatord")


def test_what_ends_with_a_run_is_where_systemd_says_else_below_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    own = Path(f"/tmp/resonatord-{os.geteuid()}")
    assert files.runtime_directory("hand") == own / "hand"
    monkeypatch.setenv("XDG_RUNTIME_DIR", "not/absolute")
    assert files.runtime_directory("hand") == own / "hand"
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert files.runtime_directory("hand") == Path("/run/user/7/resonatord/hand")
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/resonatord/left:/run/other")
    assert files.runtime_directory("hand") == Path("/run/resonatord/left")


def test_daemons_are_looked_for_wherever_one_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    uid = os.geteuid()
    by_default = (Path("/run/resonatord"), Path(f"/tmp/resonatord-{uid}"), Path(f"/run/user/{uid}/resonatord"))
    assert files.runtime_directories() == by_default
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/elsewhere")
    assert set(files.runtime_directories()) == {*by_default, Path("/elsewhere/resonatord")}
    monkeypatch.setenv("XDG_RUNTIME_DIR", f"/run/user/{uid}")
    assert sorted(files.runtime_directories()) == sorted(by_default)


def test_only_this_user_may_enter_what_is_made(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        files.make_private(tmp_path / "resonatord" / "hand")
    finally:
        os.umask(before)
    assert mode(tmp_path / "resonatord") == mode(tmp_path / "resonatord" / "hand") == 0o700
    files.make_private(tmp_path / "resonatord" / "hand")  # as at the next start


@pytest.mark.parametrize(("place", "bits"), [("outer", 0o777), ("outer/hand", 0o777), ("outer/hand", 0o1777)])
def test_a_place_where_others_can_write_is_refused(tmp_path: Path, place: str, bits: int) -> None:
    (tmp_path / "outer" / "hand").mkdir(parents=True)
    (tmp_path / place).chmod(bits)
    with pytest.raises(PermissionError, match=f"{place} belongs to user .* mode {bits:o}.*remove it"):
        files.make_private(tmp_path / "outer" / "hand")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a directory away")
def test_a_place_of_another_user_is_refused(tmp_path: Path) -> None:
    (tmp_path / "hand").mkdir(mode=0o700)
    os.chown(tmp_path / "hand", 12345, 12345)
    with pytest.raises(PermissionError, match="belongs to user 12345"):
        files.make_private(tmp_path / "hand")


@pytest.mark.parametrize("target", ["/", "/nowhere"])
def test_a_link_in_its_place_is_not_followed(tmp_path: Path, target: str) -> None:
    (tmp_path / "hand").symlink_to(target)
    with pytest.raises(OSError, match="hand"):
        files.make_private(tmp_path / "hand")


def test_a_file_gets_its_name_once_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "out"
    new = files.NewFile(path)
    new.file.write(b"12345")
    assert not path.exists()
    with pytest.raises(UserError, match=r"out\.part exists: another process writes it, or was killed"):
        files.NewFile(path)
    assert new.keep() == 5
    assert [file.name for file in tmp_path.iterdir()] == ["out"]
    assert path.read_bytes() == b"12345"


def test_a_file_created_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "out"
    new = files.NewFile(path)
    path.write_text("mine")
    with pytest.raises(UserError, match="exists already, and nothing is overwritten"):
        new.keep()
    new.discard()
    assert [file.read_text() for file in tmp_path.iterdir()] == ["mine"]
