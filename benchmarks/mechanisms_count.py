"""Numbers of hand-set constants and of lines that decide, for `benchmarks.mechanisms`.

The deciding modules are those of `DECIDING`: they choose what is fused, how much it weighs, and where the robot is.
A hand-set constant is a numeric literal other than 0, 1, 2 and 0.5, with either sign,

- in a module constant ``_NAME = number`` (each number of an array or a table counts),
- in an expression or a default argument of these modules, but for indices, shapes of arrays, and the factor between
  seconds and nanoseconds,
- in a default of the configuration's sections ``weights``, ``gate`` and ``estimator``.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "fgloc"
DECIDING = (
    "replay.py",
    "stats.py",
    "estimation/*.py",
    "sensors/learned/network.py",
    "sensors/gyro.py",
    *(f"graph/{name}.py" for name in ("batch", "estimators", "joint", "noise")),
)
SECTIONS = ("WeightsConfig", "GateConfig", "EstimatorConfig")
_NOT_COUNTED = (0.0, 0.5, 1.0, 2.0)
_NANOSECONDS = (1e9, 1e-9)
_SHAPES = {"broadcast_to", "empty", "eye", "full", "ones", "range", "repeat", "reshape", "tile", "zeros"}


@dataclass(frozen=True, slots=True)
class Literal:
    """A hand-set constant.

    Attributes:
        line: in its module.
        name: of the module constant or of the setting; "" for one in an expression.
        value: the number.
    """

    line: int
    name: str
    value: float


def deciding_modules(package: Path = PACKAGE) -> list[Path]:
    """The deciding modules that there are."""
    return sorted({path for pattern in DECIDING for path in package.glob(pattern) if path.name != "__init__.py"})


def lines(package: Path = PACKAGE) -> dict[str, int]:
    """Lines of each deciding module, by its path in the package."""
    counted = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in deciding_modules(package)}
    return {path.relative_to(package).as_posix(): n for path, n in counted.items()}


def constants(package: Path = PACKAGE) -> dict[str, list[Literal]]:
    """The hand-set constants of each deciding module and of the configuration, by path in the package."""
    found = {
        path.relative_to(package).as_posix(): list(in_source(path.read_text(encoding="utf-8")))
        for path in deciding_modules(package)
    }
    config = (package / "config.py").read_text(encoding="utf-8")
    return found | {"config.py": list(in_sections(config))}


def in_source(source: str) -> Iterator[Literal]:
    """Hand-set constants of a module."""
    tree = ast.parse(source)
    names: dict[int, str] = {}
    for statement in tree.body:
        if isinstance(statement, ast.Assign | ast.AnnAssign):
            target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
            names |= dict.fromkeys(range(statement.lineno, (statement.end_lineno or 0) + 1), ast.unparse(target))
    for line, value in _numbers(tree):
        yield Literal(line, names.get(line, ""), value)


def in_sections(source: str, sections: tuple[str, ...] = SECTIONS) -> Iterator[Literal]:
    """Hand-set defaults of sections of the configuration; bounds and descriptions of the settings do not count."""
    for node in ast.parse(source).body:
        if not isinstance(node, ast.ClassDef) or node.name not in sections:
            continue
        for setting in node.body:
            if isinstance(setting, ast.AnnAssign) and setting.value is not None:
                name = f"{node.name}.{ast.unparse(setting.target)}"
                yield from (Literal(line, name, number) for line, number in _numbers(_default(setting.value)))


def _default(value: ast.expr) -> ast.expr:
    """Default in ``Field(default, ...)``, or the value itself; None for another section, which has its own."""
    if not isinstance(value, ast.Call):
        return value
    return value.args[0] if ast.unparse(value.func) == "Field" else ast.Constant(None)


def listing(found: Mapping[str, list[Literal]]) -> str:
    """Hand-set constants as text, by module."""
    out = []
    for module, literals in found.items():
        out.append(f"{module}: {len(literals)}")
        out += [f"  {x.line:4d}  {x.value:<12g} {x.name}".rstrip() for x in literals]
    return "\n".join(out)


def _numbers(node: ast.AST) -> Iterator[tuple[int, float]]:
    """Line and value of each number below a node that is one."""
    if (value := _value(node)) is not None:
        if abs(value) not in _NOT_COUNTED:
            yield getattr(node, "lineno", 0), value
        return
    for child in ast.iter_child_nodes(node):
        value = _value(child)
        if isinstance(node, ast.Subscript) and child is node.slice:
            continue
        if value in _NANOSECONDS and isinstance(node, ast.BinOp):
            continue
        if isinstance(node, ast.Call) and child is not node.func and _makes_shape(node.func):
            yield from (found for found in _numbers(child) if not found[1].is_integer())
            continue
        yield from _numbers(child)


def _makes_shape(function: ast.expr) -> bool:
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return name in _SHAPES


def _value(node: ast.AST) -> float | None:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        inner = _value(node.operand)
        return None if inner is None else -inner
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        return float(node.value)
    return None
