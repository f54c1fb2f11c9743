"""The architecture holds: who may import whom, what the documents promise, what the shipped files leave out."""

import ast
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from config_rows import PAGES, rows, sections, tables

import fgloc
import fgloc_datasets
import fgloc_training
from fgloc_training.config import TrainConfig

ROOT = Path(fgloc.__file__).resolve().parent.parent
PACKAGES = {"fgloc": ROOT, "fgloc_datasets": ROOT / "datasets", "fgloc_training": ROOT / "training"}
MODULES = sorted(path for name, folder in PACKAGES.items() for path in (folder / name).rglob("*.py"))
BASE = {"extensions", "drives", "files", "types", "errors", "config", "frames", "se2", "stats"}
PARTS = {"recording", "sensors", "graph"}
ABOVE = {"evaluation", "ablation"}
OUTER = {  # which of the two each may import
    "fgloc_datasets": {"fgloc_datasets"},
    "fgloc_training": {"fgloc_datasets", "fgloc_training"},
}
ONLY = {  # the places that may import a library
    "rosbags": {"recording", "fgloc_datasets"},
    "mcap": {"recording"},
    "gtsam": {"graph"},
    "cv2": {"sensors", "fgloc_datasets"},
    "matplotlib": {"evaluation", "ablation", "fgloc_datasets", "fgloc_training"},
    "typer": {"cli"},
    "rich": {"cli"},
    "dask": {"ablation"},
    "distributed": {"ablation"},
    "cyclonedds": {"live"},
    "rerun": {"view"},
    "mujoco": {"fgloc_datasets"},
    "torch": {"fgloc_training"},
}
NEVER = {"datasets", "training", "benchmarks", "tests", "evo"}
IN_TORCH = {f"fgloc_training.{name}" for name in ("models", "optimize", "train")}
EXTRAS = {"dask", "distributed", "cyclonedds", "rerun", "mujoco", "torch"}  # of these packages and no other part


def imported(path):
    """Dotted names of everything that a module imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "fgloc":
                yield from (f"fgloc.{alias.name}" for alias in node.names)
            else:
                yield node.module


def part_of(path):
    """The first name below fgloc, a package or a module; outside fgloc the name of the package."""
    parts = path.relative_to(ROOT).parts
    return parts[1].removesuffix(".py")


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_follow_the_layers(path):
    part = part_of(path)
    for name in imported(path):
        top, *rest = name.split(".")
        assert top not in NEVER, f"{name} in {path}"
        assert part in ONLY.get(top, {part}), f"{name} in {path}; only {ONLY[top]} import it"
        if top in OUTER:
            assert part == "cli" or top in OUTER.get(part, ()), f"{name} in {path}: training → datasets → the rest"
        if top != "fgloc" or not rest:
            continue
        target = rest[0]
        assert target != "cli" or part in ("cli", "__main__"), f"{name} in {path}: nothing imports the command line"
        if part in BASE:
            assert target in BASE, f"{name} in {path}: the foundation stands alone"
        elif part in PARTS:
            assert target in BASE | PARTS, f"{name} in {path}: a part knows nothing of the core loop"
        elif part not in ABOVE | {*OUTER, "runner", "cli", "__init__", "__main__"}:  # a run's result can be written
            assert target not in ABOVE, f"{name} in {path}: the core does not judge itself"


def imports_of_modules():
    """Module to the modules of these packages that it imports: at its top, in functions and for types alike."""
    names = {}
    for package, folder in PACKAGES.items():
        for path in (folder / package).rglob("*.py"):
            names[".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__init__")] = path
    found = {}
    for name, path in names.items():
        froms = [n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.ImportFrom)]
        inner = {f"{node.module}.{alias.name}" for node in froms for alias in node.names}
        found[name] = ({*inner, *imported(path)} & names.keys()) - {name}
    return found


def test_imports_make_no_circle():
    """Also not by those in functions or below TYPE_CHECKING, which only hide one. The package itself names its API."""
    imports = {name: set(targets) for name, targets in imports_of_modules().items() if name != "fgloc"}
    assert len(imports) > 100
    while ready := {name for name, targets in imports.items() if not targets & imports.keys()}:
        for name in ready:
            del imports[name]
    while ends := imports.keys() - set().union(*imports.values()):  # they lead to a circle, and none leads to them
        for name in ends:
            del imports[name]
    assert not imports


def test_only_the_command_line_prints_and_exits():
    for path in MODULES:
        if part_of(path) == "cli":
            continue
        calls = [node.func for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Call)]
        names = {func.id for func in calls if isinstance(func, ast.Name)}
        names |= {
            func.attr for func in calls if isinstance(func, ast.Attribute) and ast.unparse(func).startswith("sys.")
        }
        assert not names & {"print", "exit", "quit", "breakpoint"}, path


def run_python(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)


def test_base_install_is_enough_for_every_module():
    """No module but those of the simulator and of training in torch needs an extra to be imported."""
    modules = [
        module.name
        for package in (fgloc, fgloc_datasets, fgloc_training)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    ]
    names = [name for name in modules if not name.startswith("fgloc_datasets.sim.") and name not in IN_TORCH]
    code = (
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.partition('.')[0] in {NEVER | EXTRAS!r}: raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Blocked())\n"
        f"for name in {names!r}: __import__(name)\n"
    )
    done = run_python(code)
    assert done.returncode == 0, done.stderr
    assert len(names) > 20


def test_help_does_not_wait_for_heavy_libraries():
    done = run_python(
        "import sys, fgloc.cli; print({'gtsam', 'cv2', 'matplotlib', 'scipy', 'rosbags', 'fgloc_datasets', "
        "'fgloc_training'} & set(sys.modules))"
    )
    assert done.stdout.strip() == "set()", done.stdout + done.stderr


def test_configuration_reference_is_complete():
    """Every value with its default and meaning; `python tests/config_rows.py` brings the document up to date."""
    described = [
        PAGES["configuration.md"],
        *(model for _, model in sections()),
    ]  # the first: keys outside every section
    text = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert text.endswith(tables()), "out of date: run `python tests/config_rows.py`"
    assert text.count("\n| `") == sum(len(list(rows(model))) for model in described) > 60


def test_reference_of_training_configurations_is_complete():
    """`fgloc train --init` names this page in what it writes."""
    text = (ROOT / "docs" / "identification.md").read_text(encoding="utf-8")
    assert text.endswith(tables(TrainConfig)), "out of date: run `python tests/config_rows.py`"
    assert "|  |" not in tables(TrainConfig), "a key without a description"


def test_readme_names_the_packages_that_ci_installs():
    line = re.search(r"apt-get install [^\n]*\\\n\s*([^\n]+)", (ROOT / ".ci" / "run").read_text("utf-8"))
    assert f"apt-get install {line[1].strip()}" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_links_of_the_documents_lead_somewhere():
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_no_paths_of_one_machine():
    pattern = re.compile(r"(?<![\w.])/(work|tmp|root|home)/")
    files = [*ROOT.glob("*.md"), *ROOT.glob("*.toml"), ROOT / "Makefile", *(ROOT / "docs").glob("*.md")]
    files += [p for name in ("fgloc", "datasets", "training", "benchmarks") for p in (ROOT / name).rglob("*.py")]
    assert not [str(path) for path in files if pattern.search(path.read_text(encoding="utf-8"))]


def test_constraints_pin_every_dependency():
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    pinned = {line.split("==")[0].lower() for line in text.splitlines() if "==" in line}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [*project["dependencies"], *(line for extra in project["optional-dependencies"].values() for line in extra)]
    wanted = {re.match(r"[\w.-]+", line)[0].lower() for line in lines} - {"fgloc"}
    assert {"gtsam", "torch", "evo", "dask"} <= wanted
    assert wanted <= pinned
    assert "+cpu" not in text  # a wheel for every machine
