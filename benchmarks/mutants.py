"""Which changes of single operators, constants and returns of the product the tests do not notice.

Run it with `python benchmarks/mutants.py [--package NAME]... [--count N] [--seed N]`. Each mutant runs
in a copy of the tree, until the first failure: the tests of its package that run its line, then those of whole paths
through the product. A mutant whose tests take several times as long as without it counts as killed. Mutants of types,
messages and help are not sampled. Survivors are printed as `file:line before -> after`. Lines that tests run are kept
in build/mutants until the product or the tests change.
"""

import argparse
import ast
import copy
import hashlib
import math
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from coverage import CoverageData

ROOT: Final = Path(__file__).resolve().parents[1]
MAPS: Final = ROOT / "build" / "mutants"
ABOVE: Final = ("tests/tools/replay", "tests/daemon/service", "tests/commands")  # whole paths through the product
# The tests of a package, where they are not those in the folder of its name alone.
FOLDERS: Final = {
    "base": ("tests/test_plate.py", "tests/board/config"),
    "simulators": ("tests/simulators", "tests/board/links"),
}
START_S, TIMES, MAP_S = 30.0, 4.0, 1800.0  # a run's limit: so long, and so many times what its tests take
PYTEST: Final = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist")
PRODUCTS: Final = ("resonator_daemon", "firmware_protocol", "simulators")
PAIRS: Final = ((ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn))
COMPARISONS: Final = {one: other for pair in PAIRS for one, other in (pair, pair[::-1])}
ARITHMETIC: Final = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
LARGE: Final = 100  # constants from here on are doubled: one more would be lost in rounding

# What changes nothing that runs, or only the text of a message.
TYPES: Final = ("annotation", "returns", "decorator_list", "bases", "type_params")
TEXTS: Final = ("help", "description", "metavar", "title", "epilog", "examples")
DATACLASS: Final = ("frozen", "slots", "kw_only")
LOGGERS: Final = ("log", "logger", "logging", "warnings")


@dataclass(frozen=True)
class Mutant:
    """One change: the node with this number in the walk over a file's tree."""

    path: str  # below the root
    line: int
    last_line: int  # of the statement, or of the head of a compound statement
    first_line: int
    node: int
    before: str
    after: str

    @property
    def package(self) -> str:
        return package_of(self.path)

    @property
    def id(self) -> str:
        return f"{self.path}:{self.line} {self.before} -> {self.after}"


def package_of(path: str) -> str:
    """Return the package of a file, given below the root; of the daemon's, layer and package, as `estimate/forces`."""
    parts = Path(path).parts
    return "/".join(parts[1:-1][:2]) if parts[0] == "resonator_daemon" else parts[0]


def mutated(node: ast.AST) -> ast.AST | None:
    """Return the node changed; None where nothing of it is changed."""
    changed = copy.copy(node)
    match changed:
        case ast.Compare(ops=[operator]) if type(operator) in COMPARISONS:
            changed.ops = [COMPARISONS[type(operator)]()]
        case ast.BinOp(op=operator) if type(operator) in ARITHMETIC and not isinstance(changed.left, ast.Constant):
            changed.op = ARITHMETIC[type(operator)]()
        case ast.BoolOp():
            changed.op = ast.Or() if isinstance(changed.op, ast.And) else ast.And()
        case ast.Constant(value=bool() as value):
            changed.value = not value
        case ast.Constant(value=int() | float() as value):
            changed.value = 2 * value if abs(value) >= LARGE else value + 1
        case ast.Return(value=ast.Constant(value=None)):
            return None
        case ast.Return(value=ast.expr()):
            changed.value = ast.Constant(None)
        case _:
            return None
    return changed


def runs(node: ast.AST) -> bool:
    """Return whether a node is more than types, `__all__` and the text of messages."""
    match node:
        case ast.If(test=ast.Name(id="TYPE_CHECKING") | ast.Attribute(attr="TYPE_CHECKING")):
            return False
        case ast.Assign(targets=[ast.Name(id="__all__")]) | ast.AnnAssign(annotation=ast.Name(id="TypeAlias")):
            return False
        case ast.FunctionDef(name="__repr__") | ast.JoinedStr() | ast.Raise():
            return False
        case ast.Subscript(value=ast.Name(id="Literal")) | ast.Call(func=ast.Name(id="TypeVar")):
            return False
        case ast.Call(func=ast.Attribute(value=ast.Name(id=name))) if name.lower().strip("_") in LOGGERS:
            return False
        case ast.keyword(arg=name) if name in (*TEXTS, *DATACLASS, "strict"):
            return False
    return type(node).__name__ != "TypeAlias"


def nodes(tree: ast.AST) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Walk over what runs: each node with the statement that it is part of."""
    yield from _below(tree, tree)


def _below(node: ast.AST, statement: ast.AST) -> Iterator[tuple[ast.AST, ast.AST]]:
    for name, value in ast.iter_fields(node):
        if name in TYPES:
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and runs(child):
                inner = child if isinstance(child, ast.stmt) else statement
                yield child, inner
                yield from _below(child, inner)


def mutants_of(root: Path, packages: Collection[str] | None = None) -> list[Mutant]:
    """Return every mutant of packages below a root, except constants whose name nothing that runs refers to."""
    trees = {
        path: ast.parse(path.read_text()) for product in PRODUCTS for path in sorted((root / product).rglob("*.py"))
    }
    used: Counter[str] = Counter()
    for tree in trees.values():
        for node, _ in nodes(tree):
            match node:
                case ast.Name(id=name, ctx=ast.Load()) | ast.Attribute(attr=name):
                    used[name] += 1
    chosen = {str(path.relative_to(root)): tree for path, tree in trees.items()}
    if packages:
        chosen = {path: tree for path, tree in chosen.items() if package_of(path) in packages}
    return [mutant for path, tree in chosen.items() for mutant in _of_file(path, tree, used)]


def _of_file(path: str, tree: ast.Module, used: Counter[str]) -> Iterator[Mutant]:
    unused = {id(statement) for statement in tree.body if _is_unused(statement, used)}
    for number, (node, statement) in enumerate(nodes(tree)):
        changed = mutated(node)
        if changed is None or id(statement) in unused:
            continue
        line, before = getattr(node, "lineno", 0), ast.unparse(node)
        first, last = _lines(statement)
        yield Mutant(path, line, last, first, number, before, ast.unparse(changed))


def _is_unused(statement: ast.stmt, used: Counter[str]) -> bool:
    match statement:
        case ast.AnnAssign(target=ast.Name(id=name)) | ast.Assign(targets=[ast.Name(id=name)]):
            return used[name] == 0
    return False


def _lines(statement: ast.AST) -> tuple[int, int]:
    """Return the first and last line of a statement, of a compound one without its body."""
    first, last = getattr(statement, "lineno", 0), getattr(statement, "end_lineno", 0)
    body = getattr(statement, "body", None)
    return first, max(first, body[0].lineno - 1) if isinstance(body, list) and body else last


def source_of(mutant: Mutant, text: str) -> str:
    """Return a file's text with one change."""
    tree = ast.parse(text)
    wanted = next(node for number, (node, _) in enumerate(nodes(tree)) if number == mutant.node)
    changed = mutated(wanted)

    class Change(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST | None:
            return changed if node is wanted else self.generic_visit(node)

    return ast.unparse(ast.fix_missing_locations(Change().visit(tree)))


def sample(mutants: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """Return mutants drawn from each package by its share of all, rounded up."""
    packages: dict[str, list[Mutant]] = defaultdict(list)
    for mutant in mutants:
        packages[mutant.package].append(mutant)
    drawn = random.Random(seed)
    sizes = {name: min(len(found), math.ceil(count * len(found) / len(mutants))) for name, found in packages.items()}
    return [mutant for name, found in packages.items() for mutant in drawn.sample(found, sizes[name])]


class Tests:
    """Tests of some folders of a copy of the tree: the lines that each runs, and how long it takes."""

    def __init__(self, tree: Path, stage: str, product: str) -> None:
        places = list((tree / stage).rglob("*.py")) if (tree / stage).is_dir() else [tree / stage]
        name = f"{stage.replace('/', '-')}-{product}-{digest([*places, *(tree / 'tests/support').rglob('*.py')])}"
        self._lines, seconds = MAPS / f"{name}.coverage", MAPS / f"{name}.txt"
        if not seconds.exists():
            print(f"maps the lines that {stage} runs", file=sys.stderr, flush=True)
            MAPS.mkdir(parents=True, exist_ok=True)
            asked = ("--cov", "--cov-context=test", "--cov-report=", "--durations=0", "-vv", stage)
            environment = os.environ | {"COVERAGE_FILE": str(self._lines), "PYTHONPATH": str(tree)}
            run = subprocess.run(
                [sys.executable, *PYTEST, *asked],
                cwd=tree,
                env=environment,
                capture_output=True,
                text=True,
                timeout=MAP_S,
            )
            if run.returncode not in (0, 1):
                raise RuntimeError(f"tests of {stage}: {run.stdout[-1000:]}")
            seconds.write_text(run.stdout)
        report = seconds.read_text()
        self.seconds: dict[str, float] = defaultdict(float)
        for spent, test in re.findall(r"^([\d.]+)s \w+ +(\S.*)$", report, re.MULTILINE):
            self.seconds[test] += float(spent)
        self._failed = set(re.findall(r"^FAILED (.+?)(?: - .*)?$", report, re.MULTILINE))

    def of(self, mutant: Mutant, tree: Path, *, is_own: bool) -> set[str]:
        """Return the tests that run a line of a mutant; where only imports and child processes do, all of its own."""
        data = CoverageData(str(self._lines))
        data.read()
        contexts = data.contexts_by_lineno(str(tree / mutant.path))
        lines = range(mutant.first_line, mutant.last_line + 1)
        tests = {context.partition("|")[0] for line in lines for context in contexts.get(line, ())}
        if tests == {""} and is_own:  # of an import, or of a child process: any of them may depend on it
            tests = set(self.seconds)
        return (tests & self.seconds.keys()) - self._failed


class Judge:
    """Runs mutants in a copy of the tree, which stays at one place, so that maps of lines hold."""

    def __init__(self, tree: Path, product: str) -> None:
        self._tree, self._product = tree, product
        self._stages: dict[str, Tests] = {}

    def survives(self, mutant: Mutant) -> bool:
        place = self._tree / mutant.path
        original = place.read_text()
        folders = FOLDERS.get(mutant.package, (f"tests/{mutant.package}",))
        for stage in dict.fromkeys((*folders, *ABOVE)):
            if not (self._tree / stage).exists():
                continue
            if stage not in self._stages:
                self._stages[stage] = Tests(self._tree, stage, self._product)
            known = self._stages[stage]
            tests = known.of(mutant, self._tree, is_own=stage in folders)
            if not tests:
                continue
            place.write_text(source_of(mutant, original))
            try:
                limit_s = START_S + TIMES * sum(known.seconds[test] for test in tests)
                if self._fails(sorted(tests, key=lambda test: known.seconds[test]), limit_s):
                    return False
            finally:
                place.write_text(original)
        return True

    def _fails(self, tests: list[str], limit_s: float) -> bool:
        environment = os.environ | {"PYTHONPATH": str(self._tree), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, *PYTEST, "-x", *tests]
        process = subprocess.Popen(
            command,
            cwd=self._tree,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            return process.wait(limit_s) not in (0, 5)
        except subprocess.TimeoutExpired:
            return True
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # what its tests have started, too
            process.wait()


def digest(paths: Collection[Path]) -> str:
    found = hashlib.sha256()
    for path in sorted(paths):
        found.update(path.read_bytes())
    return found.hexdigest()[:16]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=220, help="mutants, at least one of each package")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--package", action="append", metavar="NAME", help="all packages, unless given")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    chosen = sample(mutants_of(ROOT, options.package), options.count, options.seed)
    product = digest([path for name in PRODUCTS for path in (ROOT / name).rglob("*.py")])
    of, killed, survivors, began_s = Counter[str](), Counter[str](), list[str](), time.monotonic()
    tree = Path(tempfile.gettempdir()) / f"mutants-{product}"
    shutil.rmtree(tree, ignore_errors=True)
    ignored = shutil.ignore_patterns(".venv", ".git", ".*_cache", "__pycache__", "build", ".hypothesis")
    try:
        judge = Judge(Path(shutil.copytree(ROOT, tree, ignore=ignored)), product)
        for done, mutant in enumerate(chosen, 1):
            survives = judge.survives(mutant)
            of[mutant.package] += 1
            killed[mutant.package] += not survives
            survivors += [mutant.id] * survives
            left_min = (time.monotonic() - began_s) / done * (len(chosen) - done) / 60.0
            outcome = "SURVIVED" if survives else "killed"
            print(f"{done}/{len(chosen)}, {left_min:.1f} min left: {outcome} {mutant.id}", file=sys.stderr, flush=True)
    finally:
        shutil.rmtree(tree)
    for name in sorted(of):
        print(f"{name:20} {killed[name]:4} of {of[name]:4} killed")
    print(
        f"{'all':20} {killed.total():4} of {of.total():4} killed, {100.0 * killed.total() / max(1, of.total()):.1f} %"
    )
    print("\n".join(survivors))
    return 0


if __name__ == "__main__":
    sys.exit(main())
