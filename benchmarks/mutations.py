"""The changes that `mutants.py` makes to the product: single operators, constants and returns of code that runs."""

import ast
import copy
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

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
    copy: int  # counts equal changes of one line

    @property
    def package(self) -> str:
        return package_of(self.path)

    @property
    def id(self) -> str:
        again = f" ({self.copy})" if self.copy > 1 else ""
        return f"{self.path}:{self.line} {self.before} -> {self.after}{again}"


def package_of(path: str) -> str:
    """Return the package of a file, given below the root; of files next to the packages of the daemon, the daemon's."""
    parts = Path(path).parts
    return parts[1] if parts[0] == "resonator_daemon" and len(parts) > 2 else parts[0]


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
    seen: Counter[tuple[int, str]] = Counter()
    unused = {id(statement) for statement in tree.body if _is_unused(statement, used)}
    for number, (node, statement) in enumerate(nodes(tree)):
        changed = mutated(node)
        if changed is None or id(statement) in unused:
            continue
        line, before = getattr(node, "lineno", 0), ast.unparse(node)
        seen[line, before] += 1
        first, last = _lines(statement)
        yield Mutant(path, line, last, first, number, before, ast.unparse(changed), seen[line, before])


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
