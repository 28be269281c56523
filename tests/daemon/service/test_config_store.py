"""The configuration in use: kept as a whole, replaced by its last good copy, and read again."""

import errno
import logging
import os
import stat
from pathlib import Path

import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate import load_plate
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.config.values import plate_text
from resonator_daemon.daemon.service.config_store import ConfigStore

GOOD = (
    'name = "left"\nplate = "own.toml"\nlink = "tcp://127.0.0.1:5000"\n[mqtt]\nusername = "a"\npassword_file = "pw"\n'
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "own.toml").write_text(plate_text(load_plate("quartz16")))
    (tmp_path / "pw").write_text("secret\n")
    path = tmp_path / "left.toml"
    path.write_text(GOOD)
    return path


def store(path: Path) -> ConfigStore:
    return ConfigStore(path, path.parent / "state" / "last-good")


def copies(path: Path) -> list[Path]:
    return sorted((path.parent / "state" / "last-good").iterdir())


def refused(path: Path) -> tuple[str, ...]:
    with pytest.raises(ConfigurationError) as caught:
        store(path).load()
    return caught.value.messages


def test_a_good_file_is_in_use_and_kept_for_its_owner_alone(path: Path) -> None:
    loaded = store(path).load()
    assert (loaded.in_use, loaded.problems) == ("file", ())
    assert loaded.config.name == "left"
    (copy,) = copies(path)
    assert copy.name.startswith("left-")
    assert stat.S_IMODE(copy.stat().st_mode) == 0o600
    assert "secret" not in copy.read_text()


def test_a_bad_file_is_made_up_for_by_the_last_good_copy(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    good = store(path).load()
    path.write_text(GOOD.replace('"left"', '"a b"') + "prefix = 5\n")
    loaded = store(path).load()
    assert (loaded.in_use, loaded.sha256, loaded.config) == ("last_good", good.sha256, good.config)
    assert [problem.removeprefix(f"{path}:")[:8] for problem in loaded.problems] == ["1: name:", "7: mqtt."]
    assert [record.message.partition(",")[0] for record in caplog.records] == [
        f"{path} cannot be used; running on the last good copy",
        *(problem.partition(",")[0] for problem in loaded.problems),
    ]


@pytest.mark.parametrize("content", ["format = 2\n", None])
def test_the_plate_is_kept_with_it(path: Path, content: str | None) -> None:
    """The configuration is as before, and the plate's own file is bad, or gone."""
    good = store(path).load()
    (path.parent / "own.toml").unlink()
    if content is not None:
        (path.parent / "own.toml").write_text(content)
    loaded = store(path).load()
    assert (loaded.in_use, loaded.config) == ("last_good", good.config)
    assert all("plate: got 'own.toml'" in problem for problem in loaded.problems)


def test_paths_of_the_copy_are_relative_to_the_file_as_before(path: Path) -> None:
    store(path).load()
    path.write_text("bad\n")
    (path.parent / "pw").write_text("changed\n")
    assert store(path).load().config.mqtt.password == "changed"
    (path.parent / "pw").unlink()
    bad, copy = refused(path)
    assert bad.startswith(f"{path}:1: not TOML")
    assert copy.startswith("the last good copy cannot be used either: ")
    assert "mqtt.password_file: got 'pw'" in copy


def test_another_file_of_the_same_name_has_a_copy_of_its_own(path: Path) -> None:
    store(path).load()
    other = path.parent / "other" / "left.toml"
    other.parent.mkdir()
    other.write_text("bad\n")
    with pytest.raises(ConfigurationError) as caught:
        ConfigStore(other, path.parent / "state" / "last-good").load()
    assert len(caught.value.messages) == 1  # nothing is said of a copy


@pytest.mark.parametrize("content", [b"", b"{}", b"\xff", b'{"format": 2}'])
def test_a_damaged_copy_is_said_and_replaced(path: Path, content: bytes) -> None:
    store(path).load()
    (copy,) = copies(path)
    copy.write_bytes(content)
    path.write_text("bad\n")
    damaged = refused(path)[1]
    assert damaged == f"{copy}: is damaged; no last good copy"
    path.write_text(GOOD)
    store(path).load()
    path.write_text("bad\n")
    assert store(path).load().in_use == "last_good"


def test_a_state_directory_that_takes_nothing_stops_nobody(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (path.parent / "state").write_text("")
    keeper = store(path)
    assert keeper.load().in_use == keeper.load().in_use == "file"
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "Not a directory" in record.message
    path.write_text("bad\n")
    assert "Not a directory; no last good copy" in refused(path)[1]


def test_a_full_disk_leaves_the_old_copy(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store(path).load()
    path.write_text(GOOD.replace('"left"', '"right"'))

    def full(_number: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert store(path).load().config.name == "right"
    assert "No space left on device" in caplog.text
    assert len(copies(path)) == 1
    path.write_text("bad\n")
    assert store(path).load().config.name == "left"


PLAIN = 'name = "left"\nplate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n'


def in_use(path: Path) -> ConfigStore:
    present = store(path)
    present.load()
    return present


async def test_what_can_change_live_is_taken_and_the_rest_is_named_until_a_restart(path: Path) -> None:
    path.write_text(PLAIN)
    present = in_use(path)
    assert (present.remark, present.status.in_use, present.status.needs_restart) == (None, "file", ())
    assert present.status.reason_code is None
    first = present.sha256
    path.write_text(PLAIN.replace("5000", "5001") + "[measurement]\nwindow_ms = 20\n")
    found = await present.reload()
    assert (found.live, found.restart) == (("measurement.window_ms",), ("link",))
    assert (present.config.measurement.window_ms, str(present.config.link)) == (20.0, "tcp://127.0.0.1:5000")
    assert present.remark == Reason(ReasonCode.RESTART_NEEDED, "restart for changed link")
    assert present.status.reason_code == "restart_needed"
    assert present.status.needs_restart == ("link",)
    assert present.sha256 != first
    path.write_text(PLAIN)  # as it was at the start
    await present.reload()
    assert (present.remark, present.config.measurement.window_ms, present.sha256) == (None, 10.0, first)


async def test_a_daemon_that_began_on_the_last_good_one_says_so_until_the_file_is_mended(path: Path) -> None:
    path.write_text(PLAIN)
    in_use(path)
    path.write_text(PLAIN + "wrong = 1\n")
    present = in_use(path)
    assert present.status.in_use == "last_good"
    assert present.remark.text.startswith(f"on the last good configuration: {path}:4: wrong: unknown key")
    path.write_text(PLAIN + "worse = 1\n")
    await present.reload()
    assert present.remark.text.startswith(f"on the last good configuration: {path}:4: worse: unknown key")
    path.write_text(PLAIN + "[measurement]\nstep_ms = 2\n")
    await present.reload()
    assert (present.remark, present.status.in_use, present.config.measurement.step_ms) == (None, "file", 2.0)
