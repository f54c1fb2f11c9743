"""Share of small changes of the deciding code that the tests notice.

mutants.caught, mutants.caught.PACKAGE   of the mutants drawn, in the tests that execute them (see `mutants_tests`)
mutants.false_alarms                     of the first twenty: share whose tests fail, or are late, on the unchanged file

A mutant is one change of one statement: a comparison turned or shifted, ``and`` for ``or``, a condition negated, ``-``
for ``+``, a constant times ten or zero, a keyword dropped, a neutral result, a statement, ``continue`` or ``break``
removed. Texts, types, assertions, errors and logs stay. For each, the quickest tests that execute the line run in a
copy of the working tree; it is caught if one fails, or if they take five times their durations. Maps of the tests and
finished mutants are kept (``FGLOC_BENCHMARK_CACHE``), so that an interrupted run goes on.

``--only PACKAGE``, ``--seed N`` and ``--count N`` draw other mutants; ``--quick`` draws ten; ``--kept`` runs only
tests whose map is kept.
"""

from __future__ import annotations

import argparse
import ast
import functools
import hashlib
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks import common, mutants_tests
from benchmarks.common import Row, mean_row
from benchmarks.mutants_tests import PACKAGES, ROOT, TestMap, Tree, caught, hash_of, map_of_tests

_COUNT, _QUICK = 200, 10
_UNCHANGED = 20  # mutants whose tests are also run on the unchanged file
_TURNED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_SHIFTED: dict[type[ast.cmpop], type[ast.cmpop]] = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_NEUTRAL = {
    "bool": ("False", "True"), "int": ("0",), "float": ("0.0",), "list": ("[]",), "dict": ("{{}}",), "tuple": ("()",),
    "set": ("set()",), "frozenset": ("frozenset()",), "None": ("None",), "FloatArray": ("np.zeros_like({})",),
}  # fmt: skip
_SILENT = {"__repr__", "__str__", "__post_init__"}
_NOTES = {"debug", "info", "warning", "error", "exception", "warn", "print", "__init__"}


@dataclass(frozen=True)
class Mutant:
    """One change of one file.

    Attributes:
        file: relative to the root.
        line: of the change.
        names: of what is changed where only an import executes it; tests of the lines that use it are run.
        before: the source that is replaced, at ``start`` to ``end`` (bytes).
    """

    file: Path
    line: int
    last_line: int
    before: str
    after: str
    start: int
    end: int
    names: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Source of the changed file."""
        source = (ROOT / self.file).read_bytes()
        return (source[: self.start] + self.after.encode() + source[self.end :]).decode()

    def __str__(self) -> str:
        before, after = (" ".join(text.split()) for text in (self.before, self.after))
        return f"{self.file}:{self.line}: {before}  ->  {after}"


# --- The changes ------------------------------------------------------------------------------------------------------


@functools.cache
def _with_default() -> dict[str, set[str]]:
    """Parameters and fields with a default that each callable of fgloc of this name has."""
    found: dict[str, set[str]] = {}
    for file in (ROOT / "fgloc").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_bytes())):
            names: set[str] = set()
            if isinstance(node, ast.FunctionDef):
                positional, keyword = node.args.args, node.args.kwonlyargs
                names = {a.arg for a in positional[len(positional) - len(node.args.defaults) :]}
                names |= {a.arg for a, default in zip(keyword, node.args.kw_defaults, strict=True) if default}
            elif isinstance(node, ast.ClassDef):
                names = {
                    n.target.id
                    for n in node.body
                    if isinstance(n, ast.AnnAssign) and n.value and isinstance(n.target, ast.Name)
                }
            else:
                continue
            found[node.name] = found[node.name] & names if node.name in found else names
    return found


def _is_text(node: ast.AST) -> bool:
    return any(
        isinstance(n, ast.JoinedStr) or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in ast.walk(node)
    )


def _is_whole(node: ast.expr) -> bool:
    """Whether a compared value is a count, so that a bound may be met exactly."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int) and not isinstance(node.value, bool)
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "len"


def _neutral(node: ast.Return, returns: ast.expr | None) -> Iterator[str]:
    if node.value is None or returns is None or (isinstance(node.value, ast.Constant) and node.value.value is None):
        return
    kinds = [n.strip().partition("[")[0] for n in ast.unparse(returns).strip("'\"").split("|")]
    for kind in [kinds[-1]] if kinds[-1] == "None" else kinds[:1]:
        for text in _NEUTRAL.get(kind, ()):
            if (neutral := text.format(ast.unparse(node.value))) != ast.unparse(node.value):
                yield f"return {neutral}"


def _changed(node: ast.expr) -> Iterator[str]:
    """Other expressions in place of one."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        op, right = type(node.ops[0]), node.comparators[0]
        if op in _TURNED:
            yield ast.unparse(ast.Compare(node.left, [_TURNED[op]()], node.comparators))
        if op in _SHIFTED and (_is_whole(right) or _is_whole(node.left)):
            yield ast.unparse(ast.Compare(node.left, [_SHIFTED[op]()], node.comparators))
    elif isinstance(node, ast.BoolOp):
        yield f"({ast.unparse(ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values))})"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield f"bool({ast.unparse(node.operand)})"
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub) and not _is_text(node):
        if not any(isinstance(side, ast.List | ast.Tuple | ast.ListComp) for side in (node.left, node.right)):
            other = ast.Sub() if isinstance(node.op, ast.Add) else ast.Add()
            yield f"({ast.unparse(ast.BinOp(node.left, other, node.right))})"
    elif isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        for keyword in node.keywords:
            default = keyword.arg in _with_default().get(name, ())
            if default and not (isinstance(keyword.value, ast.Constant) and keyword.value.value is None):
                rest = [k for k in node.keywords if k is not keyword]
                yield ast.unparse(ast.Call(node.func, node.args, rest))
        for argument in [a for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, float)]:
            for value in {argument.value * 10.0, 0.0} - {argument.value}:
                args = [ast.Constant(value) if a is argument else a for a in node.args]
                yield ast.unparse(ast.Call(node.func, args, node.keywords))


class _Changes(ast.NodeVisitor):
    """Collects (node, text in its place, names) of a module."""

    def __init__(self) -> None:
        self.found: list[tuple[ast.AST, str, tuple[str, ...]]] = []
        self._returns: list[ast.expr | None] = []

    def generic_visit(self, node: ast.AST) -> None:
        if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom):
            return
        if isinstance(node, ast.expr):
            self.found += [(node, text, ()) for text in _changed(node)]
        if isinstance(node, ast.If | ast.While | ast.IfExp) and isinstance(
            node.test, ast.Name | ast.Attribute | ast.Call
        ):
            self.found.append((node.test, f"(not {ast.unparse(node.test)})", ()))
        if isinstance(node, ast.Continue | ast.Break):
            self.found.append((node, "pass", ()))
        super().generic_visit(node)

    def visit_Module(self, node: ast.Module) -> None:
        for statement in node.body:
            if isinstance(statement, ast.Assign | ast.AnnAssign) and statement.value is not None:
                targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
                names = tuple(n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name))
                for value in ast.walk(statement.value):
                    if isinstance(value, ast.Constant) and type(value.value) in (int, float) and value.value:
                        self.found += [(value, repr(v), names) for v in (value.value * 10, 0)]
            elif isinstance(statement, ast.FunctionDef | ast.ClassDef):
                self.visit(statement)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name in _SILENT or (node.returns is not None and ast.unparse(node.returns) in ("str", "'str'")):
            return
        self._returns.append(node.returns)
        for statement in node.body:
            self.visit(statement)
        self._returns.pop()

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for statement in node.body:
            if isinstance(statement, ast.FunctionDef | ast.ClassDef):
                self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Return(self, node: ast.Return) -> None:
        self.found += [(node, text, ()) for text in _neutral(node, self._returns[-1])]
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call):
            name = getattr(node.value.func, "attr", getattr(node.value.func, "id", ""))
            if name in _NOTES:
                return
            self.found.append((node, "pass", ()))
            self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if not _is_text(node.value):
            self.found.append((node, "pass", ()))
        self.generic_visit(node)


def mutants_of(file: Path) -> list[Mutant]:
    """All changes of a file that compile."""
    source = (ROOT / file).read_bytes()
    begins = [0]
    for line in source.splitlines(keepends=True):
        begins.append(begins[-1] + len(line))
    changes = _Changes()
    changes.visit(ast.parse(source))
    made = []
    for node, after, names in changes.found:
        start = begins[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]
        end = begins[node.end_lineno - 1] + node.end_col_offset  # type: ignore[attr-defined]
        before = source[start:end].decode()
        made.append(Mutant(file, node.lineno, node.end_lineno, before, after, start, end, names))  # type: ignore[attr-defined]
    return made


def drawn(count: int, seed: int, only: str | None) -> list[Mutant]:
    """Mutants, as many of each package; of one line at most one; the same ones where the code is the same."""
    packages = [only] if only else list(PACKAGES)
    chosen: list[list[Mutant]] = []
    for package in packages:
        ranked = []
        for file in (f for f in mutants_tests.sources() if f.parts[1] == package):
            alike: Counter[tuple[str, str]] = Counter()
            for m in mutants_of(file):
                alike[m.before, m.after] += 1
                what = f"{seed} {file} {m.before} {m.after} {alike[m.before, m.after]}"
                ranked.append((hashlib.sha256(what.encode()).hexdigest(), m))
        everything = [m for _, m in sorted(ranked, key=lambda pair: pair[0])]
        each = {(m.file, m.line): m for m in reversed(everything)}
        chosen.append([m for m in everything if each[m.file, m.line] is m])
    return [m for group in zip(*chosen, strict=False) for m in group][:count]  # so that a part of a run is fair too


# --- The run ----------------------------------------------------------------------------------------------------------


@functools.cache
def _uses() -> dict[str, set[tuple[str, int]]]:
    """Lines of the packages in which each name is read."""
    found: dict[str, set[tuple[str, int]]] = {}
    for file in mutants_tests.sources():
        for node in ast.walk(ast.parse((ROOT / file).read_bytes())):
            name = node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else None
            if name is not None:
                found.setdefault(name, set()).add((str(file), node.lineno))  # type: ignore[attr-defined]
    return found


def _tests_of(mutant: Mutant, tests: TestMap) -> list[str]:
    places = {(str(mutant.file), line) for line in range(mutant.line, mutant.last_line + 1)}
    for name in mutant.names:
        own = name.startswith("_")  # others of this name are other constants
        places |= {place for place in _uses().get(name, set()) if not own or place[0] == str(mutant.file)}
    return tests.of(places)


def judged(tree: Tree, mutants: Iterable[Mutant], tests: TestMap) -> Iterator[tuple[Mutant, bool, int]]:
    """Each mutant, whether it is caught, and how many tests ran."""
    for number, mutant in enumerate(mutants):
        names = _tests_of(mutant, tests)
        what = "\n".join([mutant.text, *names, *sorted({hash_of(Path(n.partition("::")[0])) for n in names})])
        kept = mutants_tests.cache_folder() / f"mutant-{hashlib.sha256(what.encode()).hexdigest()[:20]}.json"
        if kept.exists():
            noticed = bool(json.loads(kept.read_text(encoding="utf-8")))
        else:
            noticed = bool(names) and caught(tree, mutant.file, mutant.text, tests, names)
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(noticed), encoding="utf-8")
        print(
            f"{number + 1} {'caught' if noticed else f'SURVIVED {len(names)} tests'} {mutant}",
            file=sys.stderr,
            flush=True,
        )
        yield mutant, noticed, len(names)


def false_alarm(tree: Tree, mutant: Mutant, tests: TestMap) -> bool:
    """Whether the tests of a mutant "catch" the unchanged file too."""
    names, unchanged = _tests_of(mutant, tests), (ROOT / mutant.file).read_text(encoding="utf-8")
    return bool(names) and caught(tree, mutant.file, unchanged, tests, names)


def main() -> None:
    """Draw mutants, run the tests of each, print the survivors and the table."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--only", choices=PACKAGES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=_COUNT)
    parser.add_argument("--kept", action="store_true")
    own, others = parser.parse_known_args()

    def measure(quick: bool) -> Iterator[Row]:
        mutants = drawn(_QUICK if quick else own.count, own.seed, own.only)
        of_package, noticed = Counter[str](), Counter[str]()
        with tempfile.TemporaryDirectory(prefix="fgloc-mutants-") as name:
            tree = Tree(Path(name).resolve())
            tests, survivors = map_of_tests(tree, own.kept), []
            for mutant, found, ran in judged(tree, mutants, tests):
                of_package[mutant.file.parts[1]] += 1
                noticed[mutant.file.parts[1]] += found
                if not found:
                    survivors.append(f"{mutant}  ({ran} tests)")
            alarms = [false_alarm(tree, mutant, tests) for mutant in mutants[:_UNCHANGED]]
        print("\n".join(["survivors:", *survivors]))
        yield Row("mutants.caught", noticed.total() / of_package.total(), n=of_package.total())
        for package in of_package:
            yield Row(f"mutants.caught.{package}", noticed[package] / of_package[package], n=of_package[package])
        yield mean_row("mutants.false_alarms", alarms)

    common.main(measure, __doc__ or "", others)


if __name__ == "__main__":
    main()
