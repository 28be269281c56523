"""The systemd unit, as systemd itself reads it and as its command behaves."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from resonator_daemon.decoding.setup_cache import cached
from resonator_daemon.errors import ExitCode

UNIT = (Path(__file__).parents[2] / "systemd" / "resonatord@.service").read_text()
INSTALLED_AT = "/opt/resonatord/bin/resonatord"


def setting(name: str) -> str:
    (value,) = re.findall(rf"^{name}=(.*)$", UNIT, re.MULTILINE)
    return str(value)


def remarks_of_systemd(unit: str, directory: Path) -> str:
    """All that `systemd-analyze verify` says of a unit, whose program need not be installed."""
    analyze = shutil.which("systemd-analyze")
    assert analyze, "systemd-analyze is missing: `make test` installs it, or as root: apt-get install systemd"
    path = directory / "resonatord@.service"
    path.write_text(unit.replace(INSTALLED_AT, sys.executable))
    verify = [analyze, "verify", "--recursive-errors=no", str(path)]
    done = subprocess.run(verify, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return done.stdout


def test_systemd_has_nothing_to_remark(tmp_path: Path) -> None:
    assert remarks_of_systemd(UNIT, tmp_path) == ""


def test_systemd_remarks_on_a_misspelt_setting(tmp_path: Path) -> None:
    assert "Restrat" in remarks_of_systemd(UNIT.replace("Restart=", "Restrat="), tmp_path)


def test_no_restart_where_a_person_must_act() -> None:
    prevented = {int(status) for status in setting("RestartPreventExitStatus").split()}
    assert prevented == {ExitCode.USAGE, ExitCode.UNAVAILABLE, ExitCode.CONFIG}


def test_restarts_never_reach_systemds_limit() -> None:
    assert 5 * float(setting("RestartSec")) > 10  # systemd gives a unit up at more than 5 starts in 10 s


def test_a_user_without_a_home_keeps_its_set_ups_where_systemd_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert setting("DynamicUser") == "yes"
    directory = tmp_path / setting("CacheDirectory")
    monkeypatch.setenv("CACHE_DIRECTORY", str(directory))
    assert cached("anything", lambda: 5) == 5
    assert len(list(directory.iterdir())) == 1


def test_command_runs_and_refuses_a_missing_configuration(tmp_path: Path) -> None:
    program, *arguments = setting("ExecStart").replace("/etc/resonatord/%i", str(tmp_path / "absent")).split()
    assert program == INSTALLED_AT
    here = Path(sys.executable).with_name("resonatord")
    done = subprocess.run([here, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.CONFIG
    assert "absent.toml" in done.stderr
