"""New files are complete or absent, also after an interruption."""

from pathlib import Path

import pytest

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.host.files import NewFile


def test_a_file_gets_its_name_once_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "out"
    new = NewFile(path)
    new.file.write(b"12345")
    assert not path.exists()
    with pytest.raises(UserError, match=r"out\.part exists: another process writes it, or was killed"):
        NewFile(path)
    assert new.keep() == 5
    assert [file.name for file in tmp_path.iterdir()] == ["out"]
    assert path.read_bytes() == b"12345"


def test_a_file_created_meanwhile_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "out"
    new = NewFile(path)
    path.write_text("mine")
    with pytest.raises(UserError, match="exists already, and nothing is overwritten"):
        new.keep()
    new.discard()
    assert [file.read_text() for file in tmp_path.iterdir()] == ["mine"]
