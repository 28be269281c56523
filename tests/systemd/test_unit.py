"""The service files, as systemd and udev themselves read them and as their commands behave."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from resonator_daemon.base.errors import ExitCode

DIRECTORY = Path(__file__).parents[2] / "systemd"
UNITS = {path.name: path.read_text() for path in DIRECTORY.glob("*.service")}
INSTALLED_AT = "/opt/resonatord/bin/resonatord"
SCORE_MAX = 2.0

each_unit = pytest.mark.parametrize("name", sorted(UNITS))


def settings(name: str, key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", UNITS[name], re.MULTILINE)


def setting(name: str, key: str) -> str:
    (value,) = settings(name, key)
    return value


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = shutil.which("systemd-analyze")
    assert program, "systemd-analyze is missing: `make test` installs it, or as root: apt-get install systemd"
    return subprocess.run(
        [program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )


def score(name: str, unit: str, directory: Path) -> float:
    """How exposed a unit is, from 0 to 10."""
    (directory / name).write_text(unit)
    found = re.search(
        r"Overall exposure level for .*: ([0-9.]+)", analyze("security", "--offline=true", str(directory / name)).stdout
    )
    assert found is not None
    return float(found[1])


@each_unit
def test_systemd_has_nothing_to_remark(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(UNITS[name].replace(INSTALLED_AT, sys.executable))
    assert analyze("verify", "--recursive-errors=no", str(tmp_path / name)).stdout == ""


@each_unit
def test_little_is_exposed(name: str, tmp_path: Path) -> None:
    assert score(name, UNITS[name], tmp_path) <= SCORE_MAX
    assert score(name, UNITS[name].replace("SystemCallFilter=", "#"), tmp_path) > score(name, UNITS[name], tmp_path)


@each_unit
def test_no_restart_where_a_person_must_act(name: str) -> None:
    prevented = {int(status) for status in setting(name, "RestartPreventExitStatus").split()}
    assert prevented == {ExitCode.USAGE, ExitCode.UNAVAILABLE, ExitCode.CONFIG}


@each_unit
def test_restarts_never_reach_systemds_limit(name: str) -> None:
    assert 5 * float(setting(name, "RestartSec")) > 10  # systemd gives a unit up at more than 5 starts in 10 s


@each_unit
def test_the_user_is_one_that_sysusers_makes(name: str) -> None:
    made = re.findall(r"^u (\S+)", (DIRECTORY / "resonatord.sysusers").read_text(), re.MULTILINE)
    groups = re.findall(r"^g (\S+)", (DIRECTORY / "resonatord.sysusers").read_text(), re.MULTILINE)
    assert [setting(name, "User")] == [setting(name, "Group")] == made
    assert [group for value in settings(name, "SupplementaryGroups") for group in value.split()] in ([], groups)


@each_unit
def test_command_runs_and_refuses_a_missing_configuration(name: str, tmp_path: Path) -> None:
    program, *arguments = setting(name, "ExecStart").replace("/etc/resonatord/%i", str(tmp_path / "absent")).split()
    assert program == INSTALLED_AT
    here = Path(sys.executable).with_name("resonatord")
    done = subprocess.run([here, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.CONFIG
    assert "absent.toml" in done.stderr


def test_udev_rules_are_for_our_ids_alone() -> None:
    text = re.sub(
        r"^#.*\n", "", (DIRECTORY / "70-resonatord.rules").read_text().replace("\\\n", ""), flags=re.MULTILINE
    )
    rules = [rule for rule in text.splitlines() if rule and not re.match(r'ACTION=="remove"|LABEL=', rule)]
    ours = re.compile(r'ATTRS?\{idVendor\}=="1209", ATTRS?\{idProduct\}=="0001"|ENV\{RESONATORD\}=="1"')
    assert len(rules) == 5
    assert [rule for rule in rules if not ours.search(rule)] == []
