"""Tests in forked processes on a copy of the working tree, and which of them execute which line.

The libraries are loaded once; fgloc is imported by each forked process anew, from the copy, which may hold a mutant.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import cache_from_source
from pathlib import Path
from types import FrameType

import coverage
import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("estimation", "graph", "calibration", "diagnosis", "live")
_FOLDERS = (
    *("estimation", "graph", "calibration", "live", "diagnosis", "faults", "replay", "drives", "sensors", "cli"),
    *("ablation", "evaluation", "fuzz", "test_localizer.py", "test_api.py"),
)
_LIBRARIES = ("numpy", "scipy.stats", "scipy.optimize", "scipy.spatial", "gtsam", "cv2", "pydantic", "yaml")
_LONGEST_S = 15.0  # of processor time, traced: longer tests are left out
_VARIANTS = 8  # of a test with parameters
_BUDGET_S = 60.0  # for the tests of one mutant, by their durations without it; the first that fails ends them
_AT_MOST_S = 300.0  # for one mutant; also the tests' durations five times over, and the start
_START_S = 20.0


def cache_folder() -> Path:
    """Folder in which maps of the tests and finished mutants are kept."""
    user = os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")
    return Path(os.environ.get("FGLOC_BENCHMARK_CACHE", Path(user) / "fgloc" / "benchmarks")) / "mutants"


def sources() -> list[Path]:
    """Files that are mutated, relative to the root."""
    return sorted(p.relative_to(ROOT) for name in PACKAGES for p in (ROOT / "fgloc" / name).rglob("*.py"))


def hash_of(*files: Path) -> str:
    """Hash of the files' content."""
    return hashlib.sha256(b"\0".join((ROOT / file).read_bytes() for file in files)).hexdigest()[:16]


class Tree:
    """Copy of the tracked and new files, in which a mutant replaces a file for the time of its tests."""

    def __init__(self, folder: Path) -> None:
        self.root = folder
        command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
        names = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
        for name in filter(None, names.split("\0")):
            if (ROOT / name).is_symlink() or (ROOT / name).is_file():  # the samples are a link to a folder
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)
        for name in _LIBRARIES:
            importlib.import_module(name)
        assert not any(name.partition(".")[0] == "fgloc" for name in sys.modules), "each process imports its own fgloc"

    @contextmanager
    def mutant(self, file: Path, text: str) -> Iterator[None]:
        """Replace a file of the copy."""
        path = self.root / file
        path.write_text(text, encoding="utf-8")
        compiled = Path(cache_from_source(str(path)))
        compiled.unlink(missing_ok=True)
        try:
            yield
        finally:
            shutil.copy2(ROOT / file, path)
            compiled.unlink(missing_ok=True)

    def run(self, work: Callable[[], int], seconds: float) -> int | None:
        """Exit code of the work done in a forked process with the copy's packages; None if it took longer."""
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            os.setsid()
            os.chdir(self.root)
            sink = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(sink, stream)
            paths = [str(self.root / name) for name in ("", "training", "datasets")]
            sys.path[:] = paths + [
                p for p in sys.path if Path(p or ".").resolve() not in (ROOT, ROOT / "training", ROOT / "datasets")
            ]
            os.environ["PYTHONPATH"] = os.pathsep.join(paths)
            sys.dont_write_bytecode = False
            code = 99
            try:
                code = int(work())
            finally:
                os._exit(code)
        ends = time.monotonic() + seconds
        while (ended := os.waitpid(child, os.WNOHANG))[0] == 0 and time.monotonic() < ends:
            time.sleep(0.02)
        _kill_group(child)  # with what its tests started
        if ended[0] == 0:
            os.waitpid(child, 0)
            return None
        return os.waitstatus_to_exitcode(ended[1])


def _kill_group(leader: int) -> None:
    try:
        os.killpg(leader, signal.SIGKILL)
    except ProcessLookupError:
        return


class _Recorder:
    """Plugin of pytest: the context of coverage is the test, and of fixtures its module; durations; what failed."""

    def __init__(self, measured: coverage.Coverage) -> None:
        self._measured = measured
        self.seconds: dict[str, float] = defaultdict(float)
        self.failed: set[str] = set()

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        variants: Counter[str] = Counter()
        for item in items:
            variants[item.nodeid.partition("[")[0]] += 1
            if variants[item.nodeid.partition("[")[0]] > _VARIANTS:
                item.add_marker(pytest.mark.skip(reason="other variants of it are run"))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        self._measured.switch_context(item.nodeid.partition("::")[0])

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Item) -> None:
        self._measured.switch_context(item.nodeid)
        signal.setitimer(signal.ITIMER_PROF, _LONGEST_S)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_teardown(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] += report.duration
        if not report.passed:  # or skipped
            self.failed.add(report.nodeid)


def _too_long(_: int, frame: FrameType | None) -> None:
    """End the test, but not within coverage, whose lock would be held for ever."""
    if frame is not None and Path(frame.f_code.co_filename).is_relative_to(Path(coverage.__file__).parent):
        signal.setitimer(signal.ITIMER_PROF, 0.01)
        return
    raise TimeoutError(f"the test took more than {_LONGEST_S:.0f} s of processor time")


def _measure(file: str, out: Path, root: Path) -> int:
    signal.signal(signal.SIGPROF, _too_long)
    measured = coverage.Coverage(
        data_file=None, config_file=False, include=[str(root / "fgloc" / p / "*") for p in PACKAGES]
    )
    recorder = _Recorder(measured)
    measured.start()
    code = pytest.main(["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not slow", file], plugins=[recorder])
    measured.stop()
    data = measured.get_data()
    lines = {
        str(Path(name).relative_to(root)): {
            str(line): sorted(filter(None, at)) for line, at in data.contexts_by_lineno(name).items()
        }
        for name in data.measured_files()
    }
    passed = {name: s for name, s in recorder.seconds.items() if name not in recorder.failed}
    out.write_text(json.dumps({"seconds": passed, "lines": lines}), encoding="utf-8")
    return (
        0
        if code in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED)
        else int(code)
    )


@dataclass(frozen=True)
class TestMap:
    """Tests by the lines that they execute, and their durations [s]."""

    seconds: dict[str, float]
    lines: dict[tuple[str, int], frozenset[str]]

    def of(self, places: set[tuple[str, int]]) -> list[str]:
        """Tests that execute one of the lines: quick ones first, those of one module together, within the budget."""
        found = set().union(*(self.lines.get(place, frozenset()) for place in places))
        chosen, left = [], _BUDGET_S
        for name in sorted(found, key=lambda n: self.seconds[n]):
            if (left := left - self.seconds[name]) < 0.0 and chosen:
                break
            chosen.append(name)
        slowest: dict[str, float] = defaultdict(float)
        for name in chosen:
            slowest[name.partition("::")[0]] += self.seconds[name]
        return sorted(chosen, key=lambda n: (slowest[n.partition("::")[0]], n.partition("::")[0], self.seconds[n]))


def map_of_tests(tree: Tree, only_kept: bool = False) -> TestMap:
    """Run each test file once under coverage, unless a map of it with these sources is kept.

    Lines that only processes execute which tests start are not seen.
    """
    files = [f for name in _FOLDERS for f in sorted((ROOT / "tests" / name).glob("test_*.py"))]
    files += [ROOT / "tests" / name for name in _FOLDERS if name.endswith(".py")]
    seconds: dict[str, float] = {}
    lines: dict[tuple[str, int], set[str]] = defaultdict(set)
    for file in files:
        kept = cache_folder() / f"map-{file.stem}-{hash_of(*sources(), file)}-{_LONGEST_S:g}-{_VARIANTS}.json"
        name = str(file.relative_to(ROOT))
        if not kept.exists() and not only_kept:
            kept.parent.mkdir(parents=True, exist_ok=True)
            began = time.monotonic()
            code = tree.run(lambda name=name, kept=kept: _measure(name, kept, tree.root), 1800.0)
            print(f"{name}: {time.monotonic() - began:.0f} s, {code}", file=sys.stderr, flush=True)
        if not kept.exists():
            continue
        found = json.loads(kept.read_text(encoding="utf-8"))
        seconds |= found["seconds"]
        for source, at in found["lines"].items():
            for line, contexts in at.items():
                for context in contexts:
                    tests = (
                        [context] if "::" in context else [n for n in found["seconds"] if n.startswith(context + "::")]
                    )
                    lines[source, int(line)].update(n for n in tests if n in found["seconds"])
    return TestMap(seconds, {place: frozenset(names) for place, names in lines.items()})


def caught(tree: Tree, file: Path, text: str, tests: TestMap, names: list[str]) -> bool:
    """Whether one of the tests fails on the mutant, or takes five times its duration."""
    limit = min(_AT_MOST_S, _START_S + 5.0 * sum(tests.seconds[n] for n in names))
    arguments = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *names]
    with tree.mutant(file, text):
        return tree.run(lambda: int(pytest.main(arguments)), limit) != pytest.ExitCode.OK
