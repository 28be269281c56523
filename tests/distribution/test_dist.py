"""`make dist`: equal bytes wherever and whenever it is built; the wheel alone runs every command."""

import json
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.distribution
ROOT = Path(__file__).parents[2]
PACKAGES = ("firmware_protocol", "resonator_daemon", "simulators")


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    place = {"PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin", "HOME": str(cwd), "LANG": "C.UTF-8"} | environment
    place |= {name: value for name, value in os.environ.items() if name.startswith(("PIP_", "SSL_"))}
    done = subprocess.run(command, cwd=cwd, env=place, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


def built(checkout: Path, *before: str, umask: int, **environment: str) -> dict[str, Path]:
    """Build in a clone; return the files by their endings."""
    checkout.parent.mkdir(parents=True)
    run("git", "clone", "-q", "--no-hardlinks", ROOT, checkout, cwd=checkout.parent)
    program = (sys.executable, checkout / ".ci" / "make_dist.py")
    run("bash", "-c", f'umask {umask:03o}; exec "$@"', "-", *before, *program, cwd=checkout, **environment)
    return {re.sub(r".*-\d+\.\d+\.\d+", "", file.name): file for file in (checkout / "dist").iterdir()}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return built(tmp_path_factory.mktemp("dist") / "a" / "checkout", umask=0o022)


def test_two_builds_have_equal_bytes(files: dict[str, Path], tmp_path: Path) -> None:
    later = ("faketime", "+400 days")
    again = built(
        tmp_path / "elsewhere" / "c", *later, umask=0o077, TZ="Asia/Kathmandu", LC_ALL="C", PYTHONHASHSEED="7"
    )
    assert set(again) == set(files) == {"-py3-none-any.whl", ".tar.gz", ".cdx.json"}
    assert [ending for ending, file in files.items() if file.read_bytes() != again[ending].read_bytes()] == []


def test_every_file_of_the_packages_is_in_the_wheel(files: dict[str, Path]) -> None:
    tracked = set(run("git", "ls-files", *PACKAGES, cwd=ROOT).splitlines())
    services = {
        f"resonator_daemon/service_files/{path.name}" for path in (ROOT / "systemd").iterdir() if path.is_file()
    }
    sources = {name for name in tracked if not name.startswith("firmware_protocol/c/")} | services
    sources.discard("resonator_daemon/service_files")  # a symbolic link
    expected = {name.removeprefix("resonator_daemon/tools/python_api/import_name/") for name in sources}
    with zipfile.ZipFile(files["-py3-none-any.whl"]) as wheel:
        names = {file.filename for file in wheel.infolist()}
        modes = {file.external_attr >> 16 & 0o777 for file in wheel.infolist()}
    assert expected - names == {"__init__.py"}  # of import_name, whose folder alone is installed
    assert {name for name in names - expected if not name.startswith("resonatord-0.")} == set()
    assert modes <= {0o644, 0o664, 0o755}
    with tarfile.open(files[".tar.gz"]) as archive:
        assert {(member.uid, member.gid, member.uname, member.mode) for member in archive if member.isfile()} <= {
            (0, 0, "", mode) for mode in (0o644, 0o755)
        }


def test_the_bill_of_materials_has_each_pinned_package_and_its_hashes(files: dict[str, Path]) -> None:
    pins = (ROOT / ".ci" / "requirements" / "run.txt").read_text()
    bill = json.loads(files[".cdx.json"].read_text())
    assert bill["bomFormat"] == "CycloneDX"
    assert {f"{part['name']}=={part['version']}" for part in bill["components"]} == set(
        re.findall(r"^\S+==\S+", pins, re.M)
    )
    hashes = [entry["content"] for part in bill["components"] for entry in part["externalReferences"][0]["hashes"]]
    assert sorted(hashes) == sorted(re.findall(r"sha256:(\w+)", pins))


def test_the_wheel_alone_runs_every_command(files: dict[str, Path], tmp_path: Path) -> None:
    environment, place = tmp_path / "environment", tmp_path / "place"
    place.mkdir()
    run(sys.executable, "-m", "venv", environment, cwd=place)
    pip = (environment / "bin" / "pip", "install", "-q", "--disable-pip-version-check")
    run(*pip, "--no-deps", "--require-hashes", "-r", ROOT / ".ci" / "requirements" / "run.txt", cwd=place)
    run(*pip, "--no-deps", files["-py3-none-any.whl"], cwd=place)
    path = f"{environment / 'bin'}:/usr/bin:/bin:/usr/sbin"
    run(ROOT / "tests" / "distribution" / "commands.sh", place, cwd=place, PATH=path)
