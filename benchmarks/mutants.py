"""Changes single operators, constants and returns of the product, and counts which changes the tests notice.

`python benchmarks/mutants.py [--count N] [--seed N] [--package NAME ...] [--limit SECONDS] [--json]`. Each mutant
runs the tests of its package in a temporary copy of the tree, until the first failure. One that exceeds the limit
counts as killed. Survivors are listed as file:line with their change.
"""

import argparse
import ast
import copy
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
PRODUCTS: Final = ("resonator_daemon", "firmware_protocol", "simulators")
COMPARISONS: Final = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
ARITHMETIC: Final = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}

_SOUND: set[str] = set()  # packages whose tests pass without a mutant


@dataclass(frozen=True)
class Mutant:
    """One change: the node with this number in the walk over a file's tree."""

    path: str  # below the root
    line: int
    node: int
    before: str
    after: str

    @property
    def package(self) -> str:
        parts = Path(self.path).parts
        return parts[1] if parts[0] == "resonator_daemon" and len(parts) > 2 else parts[0]


def mutated(node: ast.AST) -> ast.AST | None:
    """Return the node changed; None where nothing of it is changed."""
    changed = copy.deepcopy(node)
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
            changed.value = value + 1
        case ast.Return(value=ast.expr()):
            changed.value = ast.Constant(None)
        case _:
            return None
    return changed


def nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Walk over what runs: neither annotations nor type statements."""
    for name, value in ast.iter_fields(tree):
        if name in {"annotation", "returns", "decorator_list"}:
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield child
                yield from nodes(child)


def mutants_of(path: Path) -> list[Mutant]:
    """Return every mutant of a file."""
    found = []
    for number, node in enumerate(nodes(ast.parse(path.read_text()))):
        changed = mutated(node)
        if changed is not None:
            before, after = ast.unparse(node), ast.unparse(changed)
            found.append(Mutant(str(path.relative_to(ROOT)), getattr(node, "lineno", 0), number, before, after))
    return found


def source_of(mutant: Mutant, text: str) -> str:
    """Return a file's text with one change."""
    tree = ast.parse(text)
    wanted = next(node for number, node in enumerate(nodes(tree)) if number == mutant.node)
    changed = mutated(wanted)

    class Change(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST | None:
            return changed if node is wanted else self.generic_visit(node)

    return ast.unparse(ast.fix_missing_locations(Change().visit(tree)))


def tests_of(mutant: Mutant, tree: Path) -> list[str]:
    """Return the tests of a mutant's package, those that are named like its file first."""
    folder = tree / "tests" / mutant.package
    if folder.is_dir():
        named = sorted(folder.glob(f"test_{Path(mutant.path).stem}*.py"))
        return [str(path.relative_to(tree)) for path in (*named, folder)]
    named = sorted((tree / "tests").rglob(f"test_{Path(mutant.path).stem}*.py"))
    return [str(path.relative_to(tree)) for path in named] or ["tests/replay"]


def fails(tests: list[str], tree: Path, limit_s: float) -> bool:
    """Run tests in a copy of the tree until the first failure."""
    command = [sys.executable, "-P", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    try:
        run = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired:
        return True
    return run.returncode != 0


def is_killed(mutant: Mutant, tree: Path, limit_s: float) -> bool:
    """Run the tests of a mutant in a copy of the tree.

    Raises
    ------
    RuntimeError
        When they fail without it.
    """
    place = tree / mutant.path
    original = place.read_text()
    place.write_text(source_of(mutant, original))
    try:
        killed = fails(tests_of(mutant, tree), tree, limit_s)
    finally:
        place.write_text(original)
    if killed and mutant.package not in _SOUND and fails(tests_of(mutant, tree), tree, 10.0 * limit_s):
        raise RuntimeError(f"tests of {mutant.package} fail without a mutant")
    _SOUND.add(mutant.package)
    return killed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--package", action="append", help="all packages, unless given")
    parser.add_argument("--limit", type=float, default=300.0, metavar="SECONDS")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    everything = [
        mutant for product in PRODUCTS for path in sorted((ROOT / product).rglob("*.py")) for mutant in mutants_of(path)
    ]
    chosen = [mutant for mutant in everything if not options.package or mutant.package in options.package]
    sample = random.Random(options.seed).sample(chosen, min(options.count, len(chosen)))
    killed: Counter[str] = Counter()
    survivors: list[Mutant] = []
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".venv", ".git", ".*_cache", "__pycache__", "build"))
        for number, mutant in enumerate(sample, 1):
            if is_killed(mutant, tree, options.limit):
                killed[mutant.package] += 1
            else:
                survivors.append(mutant)
            print(f"{number} of {len(sample)}, {len(survivors)} survived", end="\r", file=sys.stderr)
    of = Counter(mutant.package for mutant in sample)
    if options.json:
        packages = {name: {"mutants": of[name], "killed": killed[name]} for name in sorted(of)}
        print(json.dumps({"packages": packages, "survivors": [vars(mutant) for mutant in survivors]}))
        return 0
    for name in sorted(of):
        print(f"{name:20} {killed[name]:4} of {of[name]:4} killed")
    print(f"{'all':20} {killed.total():4} of {of.total():4} killed")
    for mutant in survivors:
        print(f"{mutant.path}:{mutant.line}: {mutant.before}  ->  {mutant.after}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
