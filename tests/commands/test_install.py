import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from resonator_daemon.base.errors import ExitCode
from resonator_daemon.base.host import install as module
from resonator_daemon.commands import main

ROOT = Path(__file__).parents[2]
PROGRAM = Path(sys.executable).with_name("resonatord")
SERVICES = {
    "etc/systemd/system/resonatord@.service", "etc/systemd/system/resonatord-decode@.service",
    "etc/systemd/system/resonatord-view@.service", "etc/udev/rules.d/70-resonatord.rules",
    "etc/sysusers.d/resonatord.conf", "etc/tmpfiles.d/resonatord.conf", "etc/resonatord/example.toml"
}  # fmt: skip
SHARE = "usr/local/share"
BASH = f"{SHARE}/bash-completion/completions/resonatord"
COMPLETIONS = {BASH, f"{SHARE}/zsh/site-functions/_resonatord", f"{SHARE}/fish/vendor_completions.d/resonatord.fish"}
PLACES = SERVICES | COMPLETIONS
UNIT, RULES = "etc/systemd/system/resonatord@.service", "etc/udev/rules.d/70-resonatord.rules"
HIDDEN = module.HIDDEN_FROM_SERVICES


@pytest.fixture(autouse=True)
def _seen_by_services(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever this checkout is."""
    monkeypatch.setattr(module, "HIDDEN_FROM_SERVICES", ())


def files_in(prefix: Path) -> set[str]:
    return {str(path.relative_to(prefix)) for path in prefix.rglob("*") if path.is_file()}


def installed(prefix: Path, capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, str]:
    """What an installation did with each file."""
    assert main(["install", "--prefix", str(prefix), "--json", *more]) == ExitCode.DONE
    reported = json.loads(capsys.readouterr().out)
    assert (reported["verb"], reported["ok"], reported["warning"]) == ("install", True, None)
    assert reported["program"] == str(PROGRAM)
    assert reported["commands"] == []
    return {str(Path(file["path"]).relative_to(prefix)): file["action"] for file in reported["files"]}


def test_all_is_put_below_the_prefix_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert installed(tmp_path, capsys) == dict.fromkeys(PLACES, "written")
    assert files_in(tmp_path) == PLACES
    pages = re.findall(r"\S+\.md", (tmp_path / "etc/resonatord/example.toml").read_text())
    assert pages
    assert [page for page in pages if not Path(page).is_file()] == []
    assert installed(tmp_path, capsys) == dict.fromkeys(PLACES, "unchanged")


def test_a_changed_file_is_kept_and_an_old_one_is_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    installed(tmp_path, capsys)
    changed, old, gone = (tmp_path / name for name in (UNIT, RULES, sorted(PLACES)[0]))
    changed.write_text(changed.read_text().replace("WatchdogSec=20", "WatchdogSec=60"))
    as_changed, as_new = changed.read_text(), old.read_text()
    old.write_text(module.sealed("# rules of an earlier version\n"))
    gone.unlink()
    would = {UNIT: "kept", RULES: "would_update", sorted(PLACES)[0]: "would_write"}
    assert installed(tmp_path, capsys, "--dry-run") == dict.fromkeys(PLACES, "unchanged") | would
    actions = dict.fromkeys(PLACES, "unchanged")
    actions |= {UNIT: "kept", RULES: "updated", sorted(PLACES)[0]: "written"}
    assert installed(tmp_path, capsys) == actions
    assert (changed.read_text(), old.read_text()) == (as_changed, as_new)


def test_uninstall_removes_the_installed_files_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    installed(tmp_path, capsys)
    (tmp_path / "etc/resonatord/left.toml").write_text("mine")
    (tmp_path / UNIT).write_text("changed")
    for dry, action in ((["--dry-run"], "would_remove"), ([], "removed"), ([], None)):
        assert main(["uninstall", "--prefix", str(tmp_path), "--json", *dry]) == ExitCode.DONE
        reported = json.loads(capsys.readouterr().out)
        actions = {str(Path(file["path"]).relative_to(tmp_path)): file["action"] for file in reported["files"]}
        expected = dict.fromkeys(PLACES - {UNIT}, action) if action else {}
        assert (reported["verb"], reported["commands"], actions) == ("uninstall", [], expected | {UNIT: "kept"})
    assert files_in(tmp_path) == {UNIT, "etc/resonatord/left.toml"}


def test_a_file_of_others_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    theirs = tmp_path / UNIT
    theirs.parent.mkdir(parents=True)
    theirs.write_bytes(b"[Service]\nExecStart=/bin/true \xff\n")
    assert installed(tmp_path, capsys)[UNIT] == "kept"
    assert theirs.read_bytes() == b"[Service]\nExecStart=/bin/true \xff\n"
    assert main(["install", "--prefix", str(tmp_path)]) == ExitCode.DONE
    assert f"{theirs}: kept: it was changed here" in capsys.readouterr().out


def test_bash_completes_commands_options_and_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    installed(tmp_path, capsys)
    (tmp_path / "left.toml").touch()
    for words, offered in (
        ("rec", "record"),
        ("plan ''", "codes sensors"),
        ("doctor --sec", "--seconds"),
        ("emulate --plate qu", "quartz16"),
        ("run le", "left.toml"),
    ):
        script = (
            f"source {BASH}; COMP_WORDS=(resonatord {words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); "
            'read -r _ _ _ _ function _ < <(complete -p resonatord); "$function"; echo "${COMPREPLY[*]}"'
        )
        done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert (done.stdout, done.stderr) == (f"{offered}\n", "")


def test_a_dry_run_for_this_system_names_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["install", "--dry-run", "--json"]) == ExitCode.DONE
    commands = [entry["command"] for entry in json.loads(capsys.readouterr().out)["commands"]]
    assert commands[:2] == [
        "systemd-sysusers /etc/sysusers.d/resonatord.conf",
        "systemd-tmpfiles --create /etc/tmpfiles.d/resonatord.conf",
    ]


@pytest.mark.parametrize("directory", ["/home", "/root", "/tmp"])
def test_a_program_that_services_cannot_see(
    directory: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "HIDDEN_FROM_SERVICES", HIDDEN)
    monkeypatch.setattr(os.path, "realpath", lambda path: f"{directory}/user/venv/bin/resonatord")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("nothing is installed from there"))
    assert main(["install", "--json"]) == ExitCode.FAILED
    printed = capsys.readouterr()
    reported = json.loads(printed.out)
    assert (reported["verb"], reported["ok"], reported["error"]["code"]) == ("install", False, "install")
    assert f" below {directory}," in reported["error"]["message"]
    assert printed.err == f"resonatord: {reported['error']['message']}\n"


def test_a_wheel_has_the_files(tmp_path: Path) -> None:
    """The one copy is in systemd/; the package reaches it by a link."""
    build = ["egg_info", "--egg-base", str(tmp_path), "build_py", "--build-lib", str(tmp_path / "built")]
    command = [sys.executable, "-W", "ignore", "-c", "from setuptools import setup; setup()", "--quiet", *build]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    shipped = {path.name: path.read_bytes() for path in (tmp_path / "built/resonator_daemon/service_files").iterdir()}
    assert shipped == {path.name: path.read_bytes() for path in (ROOT / "systemd").iterdir() if path.is_file()}
