"""What set-up installs depends on the files of .ci/requirements alone, not on what was published since."""

import json
import os
import re
import subprocess
import tomllib
import zipfile
from collections import defaultdict
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

pytestmark = pytest.mark.distribution
ROOT = Path(__file__).parents[2]
PINS = ROOT / ".ci" / "requirements"
FILES = [file.name for file in sorted(PINS.glob("*.txt"))]
SEVERAL = ("python3.11", "python3.12", "python3.13")
PYTHONS = [name for name in SEVERAL if subprocess.run(("sh", "-c", f"{name} -c '' 2>&-"), check=False).returncode == 0]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
ASKED = [text for extra in PROJECT["project"]["optional-dependencies"].values() for text in extra]
STAMPS = [f".venv/{name}-stamp" for name in ("run", "figures", "test", "browser", "notebook", "docs", "dist")]

Metadata = dict[str, list[Requirement]]


def pins_of(filename: str) -> dict[str, str]:
    """Return the pins by name, those for other computers left out."""
    pins = re.findall(r"^\S+==[^\\\n]+", (PINS / filename).read_text(), re.M)
    requirements = [pin for pin in map(Requirement, pins) if pin.marker is None or pin.marker.evaluate()]
    return {canonicalize_name(pin.name): f"{pin.name}{pin.specifier}" for pin in requirements}


def unmet(filename: str, metadata: Metadata, python_version: str) -> set[str]:
    """Return what packages of a file depend on, also with the extras that others ask for, and the file does not pin."""
    pins = pins_of(filename)
    extras = defaultdict(set)
    for requirement in map(Requirement, ASKED):
        extras[canonicalize_name(requirement.name)] |= requirement.extras
    environment = {"python_version": python_version, "python_full_version": f"{python_version}.9"}
    missing, before = set(), None
    while before != (before := sum(map(len, extras.values()))):  # until no package asks for a further extra
        for name in pins:
            for needed in metadata[name]:
                marker = needed.marker
                if marker is None or any(marker.evaluate(environment | {"extra": x}) for x in ("", *extras[name])):
                    key = canonicalize_name(needed.name)
                    extras[key] |= needed.extras
                    if key not in pins or not needed.specifier.contains(pins[key].split("==")[1], prereleases=True):
                        missing.add(f"{name}: {needed}")
    return missing


@pytest.fixture(scope="module", params=PYTHONS)
def python(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Metadata]:
    """Version of a Python, and what each pinned package depends on, as its pip states it."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "pins.txt").write_text("\n".join({pin for name in FILES for pin in pins_of(name).values()}))
    pip = ("-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet", "--report", "report.json")
    subprocess.run((request.param, *pip, "-r", "pins.txt"), cwd=folder, check=True)
    packages = [package["metadata"] for package in json.loads((folder / "report.json").read_text())["install"]]
    return request.param.removeprefix("python"), {
        canonicalize_name(package["name"]): [Requirement(text) for text in package.get("requires_dist", ())]
        for package in packages
    }


@pytest.mark.parametrize("filename", FILES)
def test_each_file_pins_every_dependency_of_its_packages(python: tuple[str, Metadata], filename: str) -> None:
    version, metadata = python
    assert unmet(filename, metadata, version) == set()


def test_newer_versions_of_every_package_are_not_installed(tmp_path: Path) -> None:
    newer, clone = tmp_path / "newer", tmp_path / "clone"
    newer.mkdir()
    for name in {name for filename in FILES for name in pins_of(filename)}:
        stem = f"{name.replace('-', '_')}-99999"
        with zipfile.ZipFile(newer / f"{stem}-py3-none-any.whl", "w") as wheel:
            wheel.writestr(f"{stem}.dist-info/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 99999\n")
            wheel.writestr(f"{stem}.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
            wheel.writestr(f"{stem}.dist-info/RECORD", "")
    subprocess.run(("git", "clone", "--quiet", ROOT, clone), check=True)
    links = f"{os.environ.get('PIP_FIND_LINKS', '')} {newer}"
    subprocess.run(("make", *STAMPS), cwd=clone, env=os.environ | {"PIP_FIND_LINKS": links}, check=True)
    freeze = (".venv/bin/python", "-m", "pip", "freeze", "--exclude-editable")
    installed = subprocess.run(freeze, cwd=clone, check=True, capture_output=True, text=True).stdout.splitlines()
    pinned = {f"{name}=={pin.split('==')[1]}" for filename in FILES for name, pin in pins_of(filename).items()}
    assert {f"{canonicalize_name(pin.split('==')[0])}=={pin.split('==')[1]}" for pin in installed} <= pinned
