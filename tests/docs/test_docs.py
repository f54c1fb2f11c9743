"""What the documents show works: each command and each piece of code is run, or says why it is not."""

import json
import os
import re
import shutil
import subprocess
import sys

import pytest
from doc_blocks import PAGES, ROOT, blocks
from schema_files import MODELS, schema
from source_roots import PYTHONPATH
from typer.main import get_command

from fgloc.ablation.suite import load_suite
from fgloc.cli import app
from fgloc.config import config_of, config_type, load_config
from fgloc.sensors.maps import load_map

SAMPLE = ROOT / "datasets" / "samples" / "installed_run"
LINKING = sorted(
    {*PAGES, *ROOT.glob("*.md"), *(p for top in ("datasets", "fgloc", "training") for p in (ROOT / top).rglob("*.md"))}
)
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def page_id(page):
    return page.relative_to(ROOT).as_posix()


def runnable():
    """Pages with a block to be run; those with a slow one are slow."""
    for page in PAGES:
        found = [block for block in blocks(page) if block.run]
        if found:
            marks = [pytest.mark.slow] if any(block.slow for block in found) else []
            yield pytest.param(page, marks=marks, id=page_id(page))


@pytest.fixture
def workspace(tmp_path, monkeypatch):
    """A folder as the documents take it: BAG, map.yaml and robot.yaml in it, and the commands on the path."""
    for name in ("datasets", "ablations", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "BAG").symlink_to(SAMPLE / "bag")
    for name in ("map.yaml", "robot.yaml"):
        shutil.copy(SAMPLE / name, tmp_path / name)
    command = tmp_path / "bin" / "fgloc"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m fgloc.cli "$@"\n')
    command.chmod(0o755)
    monkeypatch.setenv("PATH", f"{command.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", PYTHONPATH)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def shell(text):
    return subprocess.run(["bash", "-euo", "pipefail", "-c", text.replace("...", "")], capture_output=True, text=True)


def settled(text):
    """What a program prints, without the times that it took and the width of its columns."""
    return [re.sub(r"[\d.]+ x", "N x", " ".join(line.split())) for line in text.strip().splitlines()]


@pytest.mark.parametrize("page", list(runnable()))
def test_every_block_of_a_page_works(page, workspace):
    printed = None
    for block in blocks(page):
        where = f"{page_id(page)}, line {block.line}"
        if block.language == "text" and "output" in block.marks:
            assert printed is not None, f"{where}: no command before it"
            assert settled(printed) == settled(block.text), where
        if not block.run:
            continue
        if "after" in block.marks:
            assert shell(block.marks["after"]).returncode == 0
        if block.language == "sh":
            done = shell(block.text)
            printed = done.stdout
        else:
            done = subprocess.run([sys.executable, "-c", block.text], capture_output=True, text=True)
        assert done.returncode == int(block.marks.get("exit", 0)), f"{where}:\n{done.stdout}{done.stderr}"


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_block_has_a_language_and_a_reason_if_it_is_not_run(page):
    for block in blocks(page):
        assert block.language in ("sh", "python", "yaml", "toml", "text"), f"{page}, line {block.line}"
        assert len(block.marks.get("not run", "x" * 16)) > 15, f"{page}, line {block.line}"


def test_most_commands_are_run():
    """The comment that spares a block is an exception."""
    of_shell = [block for page in PAGES for block in blocks(page) if block.language == "sh"]
    assert sum(block.run for block in of_shell) >= 10
    assert all("robot" in why or "install" in why or "test" in why or "needs" in why
               for block in of_shell if (why := block.marks.get("not run")))  # fmt: skip


@pytest.mark.parametrize("page", [p for p in PAGES if any(b.language == "yaml" for b in blocks(p))], ids=page_id)
def test_every_piece_of_yaml_loads(page, tmp_path):
    for number, block in enumerate(b for b in blocks(page) if b.language == "yaml"):
        path = tmp_path / f"{number}.yaml"
        path.write_text(block.text, encoding="utf-8")
        if "not run" in block.marks:
            continue
        if re.search(r"^recordings:", block.text, re.M):
            assert load_suite(path).recordings
        elif re.search(r"^(landmarks|boards):\n", block.text, re.M):
            assert load_map(path).landmarks
        else:
            assert load_config(path) != config_of({})


@pytest.mark.parametrize("name", MODELS)
def test_the_schemas_for_editors_are_current(name):
    path = ROOT / "docs" / "schema" / name
    assert path.read_text(encoding="utf-8") == schema(name), "out of date: run `python tests/schema_files.py`"


@pytest.mark.parametrize("path", sorted((ROOT / "ablations").glob("*.yaml")), ids=lambda path: path.stem)
def test_suites_name_their_schema(path):
    first = path.read_text(encoding="utf-8").partition("\n")[0]
    target = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", first)[1]
    assert (path.parent / target).is_file()


def test_pictures_are_small():
    sizes = {p.name: p.stat().st_size for p in (ROOT / "docs").rglob("*") if p.suffix in (".png", ".gif")}
    assert sum(sizes.values()) < 3_000_000, sizes
    assert "run.gif" in sizes


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run_and_say_what_they_show(path, tmp_path, monkeypatch):
    """Executed as they are; printed figures are those of the page."""
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    monkeypatch.setenv("PYTHONPATH", PYTHONPATH)
    (tmp_path / "datasets").symlink_to(ROOT / "datasets")
    shown = nbformat.read(path, as_version=4)
    again = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(again, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
    for before, after in zip(shown.cells, again.cells, strict=True):
        assert printed_in(before) == printed_in(after)


def printed_in(cell):
    return [output.text for output in cell.get("outputs", ()) if output.get("name") == "stdout"]


def test_there_are_two_notebooks():
    assert len(NOTEBOOKS) == 2
    first = next(path for path in NOTEBOOKS if path.stem == "first_run")
    assert len(json.loads(first.read_text(encoding="utf-8"))["cells"]) == 5
    for path in NOTEBOOKS:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        assert any("image/png" in output.get("data", {}) for cell in cells for output in cell.get("outputs", ()))


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_asks_for_nothing(tmp_path):
    pytest.importorskip("mkdocs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = os.environ | {"PYTHONPATH": PYTHONPATH}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 20
    assert not (tmp_path / "site" / "decisions").exists(), "decision records are for people who change the code"
    for page in pages:
        loaded = re.findall(r"<(?:script|img|link)[^>]+(?:src|href)=\"?(https?://[^\" >]+)", page.read_text("utf-8"))
        assert not loaded, f"{page.name} loads {loaded[:3]}"
    text = (tmp_path / "site" / "reference" / "cli.html").read_text("utf-8")
    assert "fgloc smooth" in text
    assert 'href="reference/cli.html">command line</a>' in (tmp_path / "site" / "index.html").read_text("utf-8")
    assert "<math" in (tmp_path / "site" / "concepts.html").read_text("utf-8")


def options_of(command):
    """Names of the commands below a command, and the options of each, by the words that lead to it."""
    found = {(): {name for p in command.params for name in (*p.opts, *p.secondary_opts)} | {"--help", "-h"}}
    for name, below in getattr(command, "commands", {}).items():
        found |= {(name, *words): options for words, options in options_of(below).items()}
    return found


def prose(page):
    return re.sub(r"^ *```.*?^ *```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    """Names of a page's headings, as GitHub and the site make them, and of its places with an id."""
    heads = (re.sub(r"\]\([^)]*\)", "", head).lower() for head in re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE))
    ids = re.findall(r'\bid="([^"]+)"', prose(page))
    return {re.sub(r"[^\w\- ]", "", head).strip().replace(" ", "-") for head in heads} | set(ids)


@pytest.mark.parametrize("page", LINKING, ids=page_id)
def test_every_link_to_a_file_leads_there(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not re.match(r"\w+:", link):
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_every_option_that_a_page_names_is_one(page):
    """In sentences, and of commands that are not run."""
    known = options_of(get_command(app))
    commands = re.findall(r"`fgloc ([^`]+)`", page.read_text(encoding="utf-8"))
    for block in blocks(page):
        commands += re.findall(r"\bfgloc ([^#|;&\n]+)", block.text) if block.language == "sh" else []
    for text in commands:
        words = text.split()
        depth = next(n for n in (2, 1, 0) if tuple(words[:n]) in known)
        named = {word.strip("[]'") for word in words if word.strip("[").startswith("--")}
        assert named <= known[tuple(words[:depth])], f"{page.name}: fgloc {text}"


def test_files_and_classes_that_the_architecture_names_exist():
    """`sightings.py` beside `estimation/motion.py` is a file of some folder; `Localizer.update` is a method."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    sources = [path for folder in ("fgloc", "tests") for path in (ROOT / folder).rglob("*.py")]
    files = re.findall(r"`((?:[a-z_]+/)*[a-z_]+\.py)`", text)
    assert len(files) > 20
    assert not [name for name in files if not any(path.as_posix().endswith(f"/{name}") for path in sources)]
    code = "\n".join(path.read_text(encoding="utf-8") for path in sources if path.is_relative_to(ROOT / "fgloc"))
    named = re.findall(r"`([A-Z][a-z]\w+)(?:\.(\w+))?`", text)
    assert len(named) > 20
    assert not [name for name, _ in named if not re.search(rf"^class {name}\b", code, re.M)]
    assert not [method for _, method in named if method and not re.search(rf"^    def {method}\(", code, re.M)]


@pytest.mark.parametrize("page", [p for p in PAGES if p.parent.name != "decisions"], ids=page_id)
def test_every_setting_that_a_page_names_is_one(page):
    """Decisions may name settings that are gone; codes of findings and names of constants are written like settings."""
    folders = (ROOT / "fgloc" / name for name in ("diagnosis", "sensors", "evaluation"))
    sources = "".join(path.read_text(encoding="utf-8") for folder in folders for path in folder.rglob("*.py"))
    codes = {tuple(code.split(".")) for code in re.findall(r'"(\w+\.\w+)"', sources)}
    known = config_type().model_json_schema()
    sections = {
        name: known["$defs"][part["$ref"].rpartition("/")[2]]["properties"] if "$ref" in part else {}
        for name, part in known["properties"].items()
    }
    named = re.findall(r"`(\w+)\.([a-z]\w*)(?:\.\w+)*(?:: [^`]*)?`", page.read_text(encoding="utf-8"))
    wrong = {(section, key) for section, key in named if key not in sections.get(section, {key: None})} - codes
    no_settings = ("py", "yaml", "tum", "growth")  # files; a row of a benchmark
    assert not {pair for pair in wrong if pair[1] not in no_settings}, page
