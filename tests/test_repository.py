"""The repository keeps its own manners: pins, reasons, packages, and nothing else at top level."""

import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PINS = ROOT / ".ci" / "requirements"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())

BUILD = PROJECT["build-system"]["requires"]
EXTRAS = PROJECT["project"]["optional-dependencies"]
RUN = PROJECT["project"]["dependencies"] + EXTRAS["view"] + [name for name in EXTRAS["demo"] if "[view]" not in name]
FIGURES = RUN + EXTRAS["figures"]
TEST = FIGURES + EXTRAS["test"]
BROWSER = TEST + EXTRAS["browser"]
NOTEBOOK = TEST + EXTRAS["notebook"]
DIST = RUN + PROJECT["dependency-groups"]["dist"]
MAKE_PINS = PROJECT["dependency-groups"]["pins"]

EXACT_AND_HASHED = re.compile(
    r"(?P<name>[\w.-]+)==(?P<version>[\w.]+)(?P<marker> ; [^#]+?)?( --hash=sha256:[0-9a-f]{64})+"
)

TOP_LEVEL = {
    *("pyproject.toml", "Makefile", "README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md"),
    *("firmware_protocol", "resonator_daemon", "simulators", "tests", "systemd", "docs", "benchmarks"),
}


def pinned(filename: str) -> dict[str, str]:
    """Version of each package in a requirements file, every entry of which must be exact and hashed."""
    entries = re.sub(r"#.*\n", "", (PINS / filename).read_text()).replace("\\\n    ", "").splitlines()
    matches = {entry: EXACT_AND_HASHED.fullmatch(entry) for entry in entries}
    unfit = [entry for entry, match in matches.items() if match is None]
    assert unfit == []
    return {canonicalize_name(match["name"]): match["version"] for match in matches.values() if match}


@pytest.mark.parametrize(
    ("filename", "declared"),
    [
        ("build.txt", BUILD), ("run.txt", RUN), ("figures.txt", FIGURES), ("test.txt", TEST),
        ("browser.txt", BROWSER), ("notebook.txt", NOTEBOOK), ("dist.txt", DIST), ("pins.txt", MAKE_PINS)
    ],
)  # fmt: skip
def test_pins_satisfy_what_the_project_declares(filename: str, declared: list[str]) -> None:
    versions = pinned(filename)
    requirements = {canonicalize_name(requirement.name): requirement for requirement in map(Requirement, declared)}
    unmet = [name for name, r in requirements.items() if name not in versions or versions[name] not in r.specifier]
    assert unmet == []


def test_tests_and_benchmarks_run_on_the_versions_that_users_get() -> None:
    assert pinned("run.txt").items() <= pinned("figures.txt").items()
    assert pinned("figures.txt").items() <= pinned("test.txt").items()
    assert pinned("test.txt").items() <= pinned("browser.txt").items()
    assert pinned("test.txt").items() <= pinned("notebook.txt").items()
    assert pinned("run.txt").items() <= pinned("dist.txt").items()


def test_no_package_index_is_named() -> None:
    files = [ROOT / "pyproject.toml", ROOT / "Makefile", ROOT / ".ci" / "run", *PINS.iterdir()]
    assert [file.name for file in files if "://" in file.read_text()] == []


def test_every_package_has_an_init_file() -> None:
    """A directory without one is left out of the wheel."""
    roots = ("firmware_protocol", "resonator_daemon", "simulators")
    packages = {module.parent for root in roots for module in (ROOT / root).rglob("*.py")}
    assert [package for package in packages if not (package / "__init__.py").is_file()] == []


def test_top_level_holds_nothing_else() -> None:
    ignored = [*(ROOT / ".gitignore").read_text().replace("/\n", "\n").split(), ".*"]
    entries = {entry.name for entry in ROOT.iterdir()}
    assert {name for name in entries if not any(fnmatch(name, pattern) for pattern in ignored)} == TOP_LEVEL


def test_each_benchmark_has_a_row_in_the_page() -> None:
    page = (ROOT / "docs" / "explanation" / "performance.md").read_text()
    assert [path.name for path in (ROOT / "benchmarks").glob("*.py") if f"`{path.name}" not in page] == []
