"""Changes single operators, constants and returns of the product, and counts which changes the tests notice.

`python benchmarks/mutants.py [--package NAME] [--count N] [--seed N] [--above [FOLDER ...]] [--json FILE] ...`.

Each mutant runs in a copy of the tree, until the first failure: first the tests in the folder of its package, then
those of `--above`. It runs only the tests that run its line, those in the file of its name first. A mutant whose
tests take several times as long as without it counts as killed. Mutants of types, messages and help are not sampled.

The sample is named by the product's source, count and seed. A run that finds an earlier FILE of the same sample goes on
with it. Survivors are printed as `file:line before -> after`; `--ids FILE` runs those again that a file lists, though
lines were added above them. The lines that tests run are kept in build/mutants until the product or the tests change.
"""

import argparse
import hashlib
import json
import math
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict, deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

from mutant_tests import LineMap, TestRun, import_libraries, map_lines, start_tests
from mutations import PRODUCTS, Mutant, mutants_of, source_of

ROOT: Final = Path(__file__).resolve().parents[1]
MAPS: Final = ROOT / "build" / "mutants"  # the lines that tests run, until something changes
# Whole paths through the product: what a package's own tests let pass is shown to these.
ABOVE: Final = ("tests/replay", "tests/daemon", "tests/commands")
# The tests of a package, where they are not those in the folder of its name alone.
FOLDERS: Final = {
    "resonator_daemon": ("tests/test_plate.py", "tests/config"),
    "simulators": ("tests/simulators", "tests/links"),
    "host": ("tests/host", "tests/commands"),
    "planning": ("tests/planning", "tests/commands"),
    "toml_files": ("tests/toml_files", "tests/config"),
}
START_S: Final = 20.0  # a run's limit: this and so many times what its tests take by themselves
TIMES: Final = 4.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=220, help="mutants, at least one of each package")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--package", action="append", metavar="NAME", help="all packages, unless given")
    parser.add_argument("--workers", type=int, default=1, choices=(1, 2))
    parser.add_argument("--above", nargs="*", default=ABOVE, metavar="FOLDER", help="more tests; none: faster")
    parser.add_argument("--ids", type=Path, metavar="FILE", help="mutants to run in place of a sample")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write results here, go on with those it has")
    parser.add_argument("--minutes", type=float, default=math.inf, help="start no mutant after this time")
    options = parser.parse_args()
    mutants = mutants_of(ROOT, options.package)
    chosen = _named(options.ids, mutants) if options.ids else sample(mutants, options.count, options.seed)
    product = _digest(path for product in PRODUCTS for path in _python_files(ROOT / product))
    record = Record.at(options.json, {"product": product, "seed": options.seed, "count": options.count})
    import_libraries()
    with tempfile.TemporaryDirectory(prefix="mutants-") as place:
        trees = [copy_of_root(Path(place) / str(number)) for number in range(options.workers)]
        judge = Judge(trees, tuple(options.above), record, time.monotonic() + 60.0 * options.minutes)
        judge.run([mutant for mutant in chosen if options.ids or mutant.id not in record.outcomes])
    record.print_summary(chosen)
    return 0


def sample(mutants: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """Return mutants drawn from each package by its share of all, rounded up."""
    packages: dict[str, list[Mutant]] = defaultdict(list)
    for mutant in mutants:
        packages[mutant.package].append(mutant)
    drawn = random.Random(seed)
    sizes = {name: min(len(found), math.ceil(count * len(found) / len(mutants))) for name, found in packages.items()}
    return [mutant for name, found in packages.items() for mutant in drawn.sample(found, sizes[name])]


def _named(file: Path, mutants: list[Mutant]) -> list[Mutant]:
    """Return the mutants that a file names, each the one nearest to its line."""
    chosen = []
    for name in filter(None, map(str.strip, file.read_text().splitlines())):
        place, _, change = name.partition(" ")
        path, _, line = place.rpartition(":")
        change = change.split(" (")[0] if change.endswith(")") and not _has_change(mutants, path, change) else change
        same = [mutant for mutant in mutants if mutant.path == path and f"{mutant.before} -> {mutant.after}" == change]
        if not same:
            print(f"not there any more: {name}", file=sys.stderr)
            continue
        chosen.append(min(same, key=lambda mutant: (mutant.id != name, abs(mutant.line - int(line)))))
    return chosen


def _has_change(mutants: list[Mutant], path: str, change: str) -> bool:
    return any(mutant.path == path and f"{mutant.before} -> {mutant.after}" == change for mutant in mutants)


def folders_of(package: str) -> tuple[str, ...]:
    return FOLDERS.get(package, (f"tests/{package}",))


def copy_of_root(tree: Path) -> Path:
    ignored = shutil.ignore_patterns(".venv", ".git", ".*_cache", "__pycache__", "build", ".hypothesis")
    return Path(shutil.copytree(ROOT, tree, ignore=ignored))


@dataclass
class Outcome:
    """What became of a mutant."""

    package: str
    killed: bool
    by: str  # the test that failed, "time", or "import"; of a survivor, the number of tests that ran its line


class Record:
    """Outcomes by identifier of the mutant, kept in a file that names the sample."""

    def __init__(self, file: Path | None, named: dict[str, Any]) -> None:
        self._file, self._named = file, named
        self.product: str = named["product"]
        self.outcomes: dict[str, Outcome] = {}

    @classmethod
    def at(cls, file: Path | None, named: dict[str, Any]) -> "Record":
        """Return the record with what a file has of the same sample."""
        record = cls(file, named)
        if file is not None and file.exists():
            earlier = json.loads(file.read_text())
            if {key: earlier.get(key) for key in named} != named:
                raise SystemExit(f"{file} has another sample; remove it or give another name")
            record.outcomes = {name: Outcome(**outcome) for name, outcome in earlier["mutants"].items()}
        return record

    def add(self, mutant: Mutant, killed: bool, by: str) -> None:
        self.outcomes[mutant.id] = Outcome(mutant.package, killed, by)
        if self._file is not None:
            written = (
                {"commit": _commit()}
                | self._named
                | {"mutants": {name: asdict(outcome) for name, outcome in self.outcomes.items()}}
            )
            self._file.write_text(json.dumps(written, indent=1))

    def print_summary(self, chosen: list[Mutant]) -> None:
        seen = {mutant: self.outcomes[mutant.id] for mutant in chosen if mutant.id in self.outcomes}
        of = Counter(mutant.package for mutant in seen)
        killed = Counter(mutant.package for mutant, outcome in seen.items() if outcome.killed)
        for name in sorted(of):
            print(f"{name:20} {killed[name]:4} of {of[name]:4} killed")
        share = 100.0 * killed.total() / max(1, of.total())
        print(f"{'all':20} {killed.total():4} of {of.total():4} killed, {share:.1f} %")
        if len(seen) < len(chosen):
            print(f"{len(chosen) - len(seen)} not run yet")
        for mutant, outcome in seen.items():
            if not outcome.killed:
                print(mutant.id)


@dataclass
class _Trial:
    mutant: Mutant
    tree: Path
    stages: deque[str]  # files and folders of tests that it has yet to pass
    original: str
    run: TestRun | None = None
    tests: int = 0


class Judge:
    """Runs mutants, one in each copy of the tree at a time."""

    def __init__(self, trees: list[Path], above: tuple[str, ...], record: Record, until: float) -> None:
        self._free, self._above, self._record, self._until = list(trees), above, record, until
        self._maps: dict[str, LineMap] = {}
        self._writes = 0
        self._product = record.product

    def run(self, mutants: list[Mutant]) -> None:
        waiting, trials = deque(mutants), list[_Trial]()
        began, total = time.monotonic(), len(mutants)
        while (waiting and time.monotonic() < self._until) or trials:
            while waiting and self._free and time.monotonic() < self._until:
                trials.append(self._begin(waiting.popleft()))
            time.sleep(0.02)
            for trial in [trial for trial in trials if self._has_ended(trial)]:
                trials.remove(trial)
                done = total - len(waiting) - len(trials)
                left_s = (time.monotonic() - began) / done * (total - done)
                outcome = self._record.outcomes[trial.mutant.id]
                line = f"{done}/{total}, {left_s / 60.0:.1f} min left: {'killed' if outcome.killed else 'SURVIVED'}"
                print(f"{line} {trial.mutant.id}", file=sys.stderr, flush=True)

    def _begin(self, mutant: Mutant) -> _Trial:
        folders = folders_of(mutant.package)
        stages = [*folders, *(folder for folder in self._above if folder not in folders)]
        tree = self._free.pop()
        return _Trial(mutant, tree, deque(stages), (tree / mutant.path).read_text())

    def _has_ended(self, trial: _Trial) -> bool:
        """Start a trial's next run of tests, or return whether it has come to its end."""
        if trial.run is not None:
            if not trial.run.has_ended():
                return False
            self._write(trial, trial.original)
            run, trial.run = trial.run, None
            if run.exceeded or run.code not in {0, 5}:
                return self._end(trial, True, "time" if run.exceeded else (run.failed() or ["import"])[0])
        while trial.stages:
            if self._started(trial, trial.stages.popleft()):
                return False
        return self._end(trial, False, f"{trial.tests} tests")

    def _end(self, trial: _Trial, killed: bool, by: str) -> bool:
        self._record.add(trial.mutant, killed, by)
        self._free.append(trial.tree)
        return True

    def _started(self, trial: _Trial, stage: str) -> bool:
        mutant, lines = trial.mutant, self._map(trial.tree, stage)
        tests = lines.tests_of(mutant.path, mutant.first_line, mutant.last_line)
        if mutant.path not in lines.lines and stage in folders_of(mutant.package):
            tests = set(lines.seconds)  # it runs under another Python
        elif lines.is_of_import(mutant.path, mutant.first_line, mutant.last_line):
            word = re.compile(rf"\b{Path(mutant.path).stem}\b")
            files = {name.split("::")[0] for name in lines.seconds}
            naming = {name for name in files if word.search((trial.tree / name).read_text())}
            tests |= {test for test in lines.seconds if test.split("::")[0] in naming} - set(lines.failed)
        if not tests:
            return False
        seconds: dict[str, float] = defaultdict(float)
        for test in tests:
            seconds[test.split("::")[0]] += lines.seconds[test]
        named = f"test_{Path(mutant.path).stem}"
        files = sorted(seconds, key=lambda name: (not Path(name).name.startswith(named), seconds[name]))
        self._write(trial, source_of(mutant, trial.original))
        trial.tests += len(tests)
        trial.run = start_tests(trial.tree, files, tests, START_S + TIMES * sum(seconds.values()))
        return True

    def _write(self, trial: _Trial, text: str) -> None:
        """Write a file with a time of change of its own, so that Python compiles it anew."""
        place = trial.tree / trial.mutant.path
        place.write_text(text)
        self._writes += 1
        os.utime(place, (self._writes, self._writes))

    def _map(self, tree: Path, stage: str) -> LineMap:
        if stage not in self._maps:
            tests = _python_files(tree / stage) if (tree / stage).is_dir() else [tree / stage]
            digest = _digest([*tests, *_python_files(tree / "tests/support")])
            kept = MAPS / f"{stage.replace('/', '-')}-{self._product}-{digest}.json"
            if not kept.exists():
                print(f"maps the lines that {stage} runs", file=sys.stderr, flush=True)
                MAPS.mkdir(parents=True, exist_ok=True)
                for old in MAPS.glob(f"{stage.replace('/', '-')}-*"):
                    old.unlink()
                found = map_lines(tree, stage)
                kept.write_text(json.dumps(asdict(found)))
                if found.failed:
                    print(f"left out, since they fail without a mutant: {found.failed}", file=sys.stderr)
            self._maps[stage] = LineMap(**json.loads(kept.read_text()))
        return self._maps[stage]


def _python_files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py"))


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _commit() -> str:
    command = ["git", "describe", "--always", "--abbrev=12", "--dirty", "--exclude", "*"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
