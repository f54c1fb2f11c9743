"""How the code is built, counted: ``python -m benchmarks.structure [--quick] [--list]``.

Sizes, parameters, layers and citations, of the packages that are not tests. ``--list`` also names each offender;
``--quick`` leaves out the runs of `benchmarks.equal`.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from benchmarks.common import Row, main, not_run

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("fgloc", "datasets", "training", "benchmarks", "examples")
MAX_FUNCTION_LINES = 50
MAX_PARAMETERS = 7
MAX_FILE_LINES = 300

SENSORS = {  # name -> where it lives in fgloc/sensors, its section of the configuration, classes defined elsewhere
    "wheels": (
        ("wheels",),
        "wheels",
        ("OdometryEvent", "JointsEvent", "WheelsConfig"),
    ),
    "learned": (("learned",), "motion", ("MotionConfig",)),
    "gyro": (("gyro",), "gyro", ("ImuEvent", "GyroConfig")),
    "corners": (("markers",), "markers", ("ImageEvent", "CornersEvent", "CornerMeasurement", "MarkersConfig")),
    "range_bearing": (("range_bearing",), "", ("RangeBearingEvent", "RangeBearingMeasurement")),
    "marker_pose": (("marker_pose",), "", ("MarkerPosesEvent", "MarkerPoseMeasurement")),
    "uwb": (("uwb",), "uwb", ()),
    "gnss": (("gnss",), "gnss", ()),
}
_LISTS = ("SensorSections", "SensorInput", "built_in")  # of the registry: sections, methods of `Live`, sensors
_GENERATED = "reference/"  # pages that docs/hooks.py makes when the site is built
_CITED = re.compile(r"(?<![\w/.*<-])(?:\.\./)*[\w][\w./-]*\.(?:md|py)\b(?!\w)")

Found = list[str]


def modules(root: Path, packages: Iterable[str] = PACKAGES) -> list[Path]:
    """All modules of some packages."""
    return [path for package in packages for path in sorted((root / package).rglob("*.py"))]


def core_modules(root: Path) -> list[Path]:
    """Modules of fgloc but for those of data sets and training, which are made for particular sensors."""
    outer = (root / "fgloc" / "datasets", root / "fgloc" / "training")
    return [path for path in modules(root, ("fgloc",)) if not any(path.is_relative_to(folder) for folder in outer)]


def flat_files(root: Path) -> Found:
    """Python files directly in ``fgloc/``."""
    return [path.name for path in sorted((root / "fgloc").glob("*.py"))]


def imported(path: Path) -> set[str]:
    """Dotted names of what a module imports; of ``from a import b`` both ``a`` and ``a.b``."""
    return _imported(ast.parse(path.read_text(encoding="utf-8")))


def _imported(tree: ast.Module) -> set[str]:
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def module_name(root: Path, path: Path) -> str:
    """Dotted name of a module."""
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def localizer_imports(root: Path) -> Found:
    """Modules of fgloc that ``localizer.py`` imports."""
    known = {module_name(root, path) for path in modules(root, ("fgloc",))} - {"fgloc"}
    return sorted(imported(root / "fgloc" / "localizer.py") & known)


def functions(root: Path) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """All functions and methods, each with its place."""
    for path in modules(root):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{path.relative_to(root)}:{node.lineno} {node.name}", node


def long_functions(root: Path) -> Found:
    """Functions over 50 lines, with their docstring."""
    return [where for where, f in functions(root) if (f.end_lineno or 0) - f.lineno + 1 > MAX_FUNCTION_LINES]


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """How many a caller can give; ``self`` and ``cls`` aside."""
    names = [a.arg for a in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def is_command(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether it is an entry point of a command line: each parameter is annotated as an option or argument of typer."""
    return all(
        a.annotation and re.search(r"Annotated|Option|Bag|\bOut\b", ast.unparse(a.annotation))
        for a in function.args.args
    )


def many_parameters(root: Path) -> Found:
    """Functions with more than 7 parameters, entry points of command lines aside."""
    return [where for where, f in functions(root) if parameters(f) > MAX_PARAMETERS and not is_command(f)]


def long_files(root: Path) -> Found:
    """Modules over 300 lines."""
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules(root)}
    return [f"{path.relative_to(root)} {n}" for path, n in lines.items() if n > MAX_FILE_LINES]


def import_cycles(root: Path) -> Found:
    """Groups of modules that import each other at load time."""
    paths = modules(root)
    index = {module_name(root, path): i for i, path in enumerate(paths)}
    edges = [(i, index[name]) for i, path in enumerate(paths) for name in loaded(path) if name in index]
    links = [(a, b) for a, b in edges if a != b]
    rows, columns = np.array(links).T if links else np.zeros((2, 0), dtype=int)
    graph = coo_array((np.ones(len(links)), (rows, columns)), shape=(len(paths), len(paths)))
    _, group = connected_components(graph, directed=True, connection="strong")
    sizes = np.bincount(group)
    names = list(index)
    return [", ".join(names[i] for i in np.flatnonzero(group == g)) for g in np.flatnonzero(sizes > 1)]


def loaded(path: Path) -> set[str]:
    """Names imported when the module is loaded: not those inside functions and ``if TYPE_CHECKING``."""
    names: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} if path.name != "__init__.py" else set()
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def sensor_leaks(root: Path) -> Found:
    """Modules of fgloc, outside a sensor's own, that import it or name its classes, events, settings or its name.

    The registry may do so where it lists the sensors, and nowhere else.
    """
    found = []
    for sensor, (homes, section, classes) in SENSORS.items():
        folder = root / "fgloc" / "sensors"
        own = {path for home in homes for path in (folder / f"{home}.py", *(folder / home).rglob("*.py"))}
        defined = {node.name for path in own if path.is_file() for node in _public_classes(path)}
        for path in core_modules(root):
            if path in own:
                continue
            tree = ast.parse(path.read_text(encoding="utf-8"))
            if path == folder / "registry.py":
                tree.body = [node for node in tree.body if not _lists_sensors(node)]
            names = {name for name in _imported(tree) if name.startswith("fgloc.sensors.")}
            homemade = {name.rpartition(".")[2] for name in names} & defined
            packages = {".".join(name.split(".")[:3]) for name in names if name.split(".")[2] in homes}
            if named := sorted(homemade | packages | _names_of(tree, classes, sensor, section or "-")):
                found.append(f"{path.relative_to(root)} names {sensor}: {', '.join(named)}")
    return found


def _public_classes(path: Path) -> list[ast.ClassDef]:
    body = ast.parse(path.read_text(encoding="utf-8")).body
    return [node for node in body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]


def _lists_sensors(node: ast.stmt) -> bool:
    """Whether a statement of the registry is one of those that take a line a sensor, or an import for them."""
    return isinstance(node, ast.Import | ast.ImportFrom) or getattr(node, "name", "") in _LISTS


def _names_of(tree: ast.Module, classes: Iterable[str], sensor: str, section: str) -> set[str]:
    named = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id in classes:
            named.add(node.id)
        elif isinstance(node, ast.Attribute) and re.search(rf"(config|settings)\.{section}$", ast.unparse(node)):
            named.add(f"config.{section}")
        elif isinstance(node, ast.Constant) and re.fullmatch(rf"{sensor}(\.\w+)?", str(node.value)):
            named.add(repr(node.value))
    return named


def cited_missing(root: Path) -> Found:
    """Files (``.md``, ``.py``) cited in docstrings, comments or documents that the repository lacks."""
    there = (*modules(root, (*PACKAGES, "tests")), *documents(root), *(root / "docs").glob("*.py"))
    files = {path.relative_to(root).as_posix() for path in there} | {"docs/reference/cli.md"}  # made by docs/hooks.py
    found = []
    for path in (*modules(root, (*PACKAGES, "tests")), *documents(root)):
        text = path.read_text(encoding="utf-8")
        for cited in _CITED.findall("\n".join(prose(text)) if path.suffix == ".py" else text):
            name = cited.removeprefix("./").replace("../", "")
            if not any(file == name or file.endswith(f"/{name}") for file in files) and not name.startswith(_GENERATED):
                found.append(f"{path.relative_to(root)} cites {cited}")
    return sorted(set(found))


def documents(root: Path) -> list[Path]:
    """All Markdown pages."""
    folders = (root / name for name in ("docs", *PACKAGES))
    return [*sorted(root.glob("*.md")), *(path for folder in folders for path in sorted(folder.rglob("*.md")))]


def prose(source: str) -> Iterator[str]:
    """Docstrings and comments of a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield ast.get_docstring(node) or ""
    yield from re.findall(r"(?:^|\s)#[ :](.*)$", source, re.MULTILINE)


def new_sensor_files(root: Path) -> Found | None:
    """Files that name the example of a UWB sensor, besides itself and its tests; None: there is none yet."""
    if not (root / "examples" / "uwb.py").is_file():
        return None
    paths = [*core_modules(root), root / "pyproject.toml"]
    return [str(path.relative_to(root)) for path in paths if re.search(r"\buwb\b", path.read_text("utf-8"), re.I)]


COUNTED: dict[str, Callable[[Path], Found | None]] = {
    "structure.flat_files": flat_files,
    "structure.localizer_imports": localizer_imports,
    "structure.sensor_leaks": sensor_leaks,
    "structure.new_sensor_files": new_sensor_files,
    "structure.long_functions": long_functions,
    "structure.many_parameters": many_parameters,
    "structure.long_files": long_files,
    "structure.import_cycles": import_cycles,
    "structure.cited_missing": cited_missing,
}


def measure(quick: bool, listed: bool = False) -> Iterator[Row]:
    """All rows."""
    if quick:
        yield from not_run(["equal.differences"], "quick run")
    else:
        from benchmarks.equal import differences

        yield Row("equal.differences", len(differences()))
    yield Row("structure.localizer_lines", len((ROOT / "fgloc" / "localizer.py").read_text("utf-8").splitlines()))
    for name, count in COUNTED.items():
        found = count(ROOT)
        yield from not_run([name], "not there yet") if found is None else [Row(name, len(found))]
        for place in (found or ()) if listed else ():
            print(f"{name}: {place}")


if __name__ == "__main__":
    arguments = [argument for argument in sys.argv[1:] if argument != "--list"]
    main(lambda quick: measure(quick, listed="--list" in sys.argv), "structure of the code", arguments)
