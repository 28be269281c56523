"""Runs of chosen tests in child processes that start with the libraries imported, and the lines that each test runs."""

import contextlib
import importlib
import json
import os
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psutil

LIBRARIES: Final = (
    *("numpy", "numpy.random", "scipy.special", "scipy.fft", "scipy.optimize", "scipy.interpolate", "scipy.signal"),
    *("scipy.spatial", "scipy.linalg", "pydantic", "aiomqtt", "cbor2", "tomlkit", "rich.console", "rich.live"),
    *("prometheus_client", "serial", "mcap.reader", "mcap.writer", "asyncio", "pytest"),
)
ANY_TEST: Final = ""  # runs a line outside of a test: while its file is imported, or in a fixture of a session


def import_libraries() -> None:
    """Import the libraries that most tests need, once for all children; the product is not among them."""
    for name in LIBRARIES:
        importlib.import_module(name)


class _Chosen:
    """Plug-in of pytest: runs the chosen tests, files in the order given; writes seconds and failures."""

    def __init__(self, files: Sequence[str], tests: Collection[str] | None, report: Path, coverage: Any) -> None:
        self._files, self._tests, self._report, self._coverage = files, tests, report, coverage
        self._seconds: dict[str, float] = defaultdict(float)
        self._failed: list[str] = []

    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        kept = [item for item in items if self._tests is None or item.nodeid in self._tests]
        order = {name: number for number, name in enumerate(self._files)}
        kept.sort(key=lambda item: order.get(item.nodeid.split("::")[0], len(order)))
        config.hook.pytest_deselected(items=[item for item in items if item not in kept])
        items[:] = kept

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if self._coverage is not None:
            self._coverage.switch_context(nodeid)

    def pytest_runtest_logfinish(self) -> None:
        if self._coverage is not None:
            self._coverage.switch_context(ANY_TEST)

    def pytest_runtest_logreport(self, report: Any) -> None:
        self._seconds[report.nodeid] += report.duration
        if report.failed and report.nodeid not in self._failed:
            self._failed.append(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        self._report.write_text(json.dumps({"seconds": self._seconds, "failed": self._failed}))


@dataclass
class TestRun:
    """A child process that runs tests in a copy of the tree."""

    pid: int
    report: Path
    deadline: float  # of time.monotonic
    code: int | None = None
    exceeded: bool = False

    def has_ended(self) -> bool:
        """Return whether the process has ended; end it, with its descendants, where its time is up."""
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.code = os.waitstatus_to_exitcode(status)
            elif time.monotonic() > self.deadline:
                self.exceeded = True
                self._end()
        return self.code is not None

    def wait(self) -> None:
        while not self.has_ended():
            time.sleep(0.02)

    def failed(self) -> list[str]:
        return list(self._written()["failed"])

    def seconds(self) -> dict[str, float]:
        return dict(self._written()["seconds"])

    def _written(self) -> dict[str, Any]:
        return dict(json.loads(self.report.read_text())) if self.report.exists() else {"failed": [], "seconds": {}}

    def _end(self) -> None:
        family = psutil.Process(self.pid)
        for process in [*family.children(recursive=True), family]:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        self.code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def start_tests(
    tree: Path, files: Sequence[str], tests: Collection[str] | None, limit_s: float, *, lines_to: Path | None = None
) -> TestRun:
    """Start the tests of files in a child process, until the first failure.

    Parameters
    ----------
    tree
        Copy of the repository.
    files
        Test files or folders below it, in the order to run.
    tests
        Identifiers of the chosen tests; all, if None.
    lines_to
        Where to write the lines that each test runs, as data of coverage; then failures do not end the run.
    """
    report = tree / ".test-run.json"
    report.unlink(missing_ok=True)
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        code = 99
        try:
            code = _child(tree, files, tests, report, lines_to)
        finally:
            os._exit(code)
    return TestRun(pid, report, time.monotonic() + limit_s)


def _child(tree: Path, files: Sequence[str], tests: Collection[str] | None, report: Path, lines_to: Path | None) -> int:
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(tree)
    output = os.open(tree / ".test-run.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for descriptor in (1, 2):
        os.dup2(output, descriptor)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.environ["PYTHONPATH"] = str(tree)
    sys.path[0] = str(tree)
    sys.argv = ["pytest"]
    import pytest

    command = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:cov", f"--rootdir={tree}", *files]
    if lines_to is None:
        return int(pytest.main(["-x", *command], plugins=[_Chosen(files, tests, report, None)]))
    import coverage

    # Children of tests write their lines too, under the test that pytest names in the environment.
    settings = tree / ".test-run.coveragerc"
    sources = f"{tree}/resonator_daemon,{tree}/firmware_protocol,{tree}/simulators"
    settings.write_text(
        f"[run]\ndata_file={lines_to}\nparallel=true\nsigterm=true\ncontext=${{PYTEST_CURRENT_TEST-}}\n"
        f"source_dirs={sources}\ndisable_warnings=no-data-collected,module-not-measured,couldnt-parse\n"
    )
    measured = coverage.Coverage(
        data_file=str(lines_to), data_suffix="main", config_file=False, source_dirs=sources.split(",")
    )
    os.environ["COVERAGE_PROCESS_START"] = str(settings)
    measured.start()
    try:
        return int(pytest.main(command, plugins=[_Chosen(files, tests, report, measured)]))
    finally:
        measured.stop()
        measured.save()


@dataclass(frozen=True)
class LineMap:
    """The tests of a folder: how long each takes, which fail as they are, and which lines each runs."""

    seconds: dict[str, float]
    failed: list[str]
    lines: dict[str, dict[str, list[str]]]  # file, line, tests

    def tests_of(self, path: str, first: int, last: int) -> set[str]:
        """Return the tests that run one of the lines of a file; all, where none is known to run it by itself."""
        by_line = self.lines.get(path, {})
        tests = {test for line in range(first, last + 1) for test in by_line.get(str(line), ())}
        if tests == {ANY_TEST}:
            tests = {test for others in by_line.values() for test in others} - {ANY_TEST} or set(self.seconds)
        return {test for test in tests if test in self.seconds} - set(self.failed)

    def is_of_import(self, path: str, first: int, last: int) -> bool:
        """Return whether the lines run only while their file is imported, as constants and defaults do."""
        by_line = self.lines.get(path, {})
        return {test for line in range(first, last + 1) for test in by_line.get(str(line), ())} == {ANY_TEST}


def map_lines(tree: Path, folder: str, limit_s: float = 1800.0) -> LineMap:
    """Run the tests of a folder once and return which lines each of them runs.

    Raises
    ------
    RuntimeError
        When they do not run to their end.
    """
    import coverage

    with tempfile.TemporaryDirectory() as place:
        data_file = Path(place) / "lines"
        run = start_tests(tree, [folder], None, limit_s, lines_to=data_file)
        run.wait()
        if run.code not in {0, 1} or run.exceeded:
            raise RuntimeError(f"tests of {folder}: {(tree / '.test-run.log').read_text()[-1000:]}")
        lines: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
        for path in Path(place).iterdir():
            data = coverage.CoverageData(str(path))
            with contextlib.suppress(coverage.CoverageException):  # of a process that was killed while it wrote
                data.read()
                for name in data.measured_files():
                    for line, contexts in data.contexts_by_lineno(name).items():
                        known = {context.split(" (")[0] for context in contexts}
                        lines[os.path.relpath(name, tree)][str(line)] |= known
    in_order = {name: {line: sorted(tests) for line, tests in found.items()} for name, found in lines.items()}
    return LineMap(run.seconds(), run.failed(), in_order)
