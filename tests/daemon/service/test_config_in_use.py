"""A configuration that is read again: what is taken, what waits, and what is said of a file that is bad."""

from pathlib import Path

import pytest

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.daemon.service.config_in_use import ConfigInUse
from resonator_daemon.daemon.service.config_store import ConfigStore

GOOD = 'name = "left"\nplate = "quartz16"\nlink = "tcp://127.0.0.1:5000"\n'


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "left.toml"
    path.write_text(GOOD)
    return path


def in_use(path: Path) -> ConfigInUse:
    return ConfigInUse(ConfigStore(path, path.parent / "last-good"))


async def test_what_can_change_live_is_taken_and_the_rest_is_named_until_a_restart(path: Path) -> None:
    present = in_use(path)
    assert (present.remark, present.status.in_use, present.status.needs_restart) == (None, "file", ())
    assert present.status.reason_code is None
    first = present.sha256
    path.write_text(GOOD.replace("5000", "5001") + "[measurement]\nwindow_ms = 20\n")
    found = await present.reload()
    assert found is not None
    assert (found.live, found.restart) == (("measurement.window_ms",), ("link",))
    assert (present.config.measurement.window_ms, str(present.config.link)) == (20.0, "tcp://127.0.0.1:5000")
    assert present.remark == Reason(ReasonCode.RESTART_NEEDED, "restart for changed link")
    assert present.status.reason_code == "restart_needed"
    assert present.status.needs_restart == ("link",)
    assert present.sha256 != first
    path.write_text(GOOD)  # as it was at the start
    await present.reload()
    assert (present.remark, present.config.measurement.window_ms, present.sha256) == (None, 10.0, first)


async def test_a_daemon_that_began_on_the_last_good_one_says_so_until_the_file_is_mended(path: Path) -> None:
    in_use(path)
    path.write_text(GOOD + "wrong = 1\n")
    present = in_use(path)
    assert present.status.in_use == "last_good"
    assert present.remark is not None
    assert present.remark.text.startswith(f"on the last good configuration: {path}:4: wrong: unknown key")
    path.write_text(GOOD + "worse = 1\n")
    await present.reload()
    assert present.remark is not None
    assert present.remark.text.startswith(f"on the last good configuration: {path}:4: worse: unknown key")
    path.write_text(GOOD + "[measurement]\nstep_ms = 2\n")
    await present.reload()
    assert (present.remark, present.status.in_use, present.config.measurement.step_ms) == (None, "file", 2.0)
