"""A result is whole or the old one: after kill -9 at any system call that changes names, and with several writers."""

import multiprocessing
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from refusal import refusal

from fgloc.errors import OutputError
from fgloc.files import atomic
from fgloc.files.atomic import atomic_file, atomic_folder, check_out

NAMES = ("a", "b", "c")
CHANGES = {"os.rename", "os.link", "os.remove", "os.rmdir", "os.mkdir", "shutil.rmtree", "fgloc.exchange"}


def write(out, content, optional=True, kept=()):
    """A result of four files; the last is one that not every result has."""
    with atomic_folder(out, own=(*NAMES, "d"), kept=kept) as stage:
        for name in (*NAMES, "d") if optional else NAMES:
            (stage / name).write_text(content)


def content(out):
    """Names and texts of a folder, without temporary ones."""
    found = {p.relative_to(out).as_posix(): p.read_text() for p in sorted(out.rglob("*")) if p.is_file()}
    return {name: text for name, text in found.items() if not name.startswith(".partial-")}


def _write_and_die(out, call, kept):
    """Write a result; SIGKILL before the given change of names, counted from 1."""
    count = 0

    def watch(event, _):
        nonlocal count
        if event in CHANGES:
            count += 1
            if count == call:
                os.kill(os.getpid(), 9)

    sys.addaudithook(watch)
    write(out, "new", optional=False, kept=kept)


def kill_everywhere(tmp_path, prepare, kept=()):
    """Each state that a kill leaves, until one run gets through: list of (folder, parent)."""
    states = []
    for call in range(1, 200):
        out = tmp_path / str(call) / "out"
        prepare(out)
        child = multiprocessing.get_context("fork").Process(target=_write_and_die, args=(out, call, kept))
        child.start()
        child.join()
        states.append(out)
        if child.exitcode == 0:
            return states
        assert child.exitcode == -9
    raise AssertionError("never got through")


OLD, NEW = dict.fromkeys((*NAMES, "d"), "old"), dict.fromkeys(NAMES, "new")


def test_fault_71_kill_at_every_rename_leaves_the_old_or_the_new_result(tmp_path):
    states = kill_everywhere(tmp_path, lambda out: write(out, "old"))
    found = [content(out) for out in states]
    assert all(state in (OLD, NEW) for state in found)
    assert found[0] == OLD
    assert found[-1] == NEW
    assert len(found) > 5
    for out in states:
        write(out, "third")
        assert content(out) == dict.fromkeys((*NAMES, "d"), "third")
        assert [entry.name for entry in out.parent.iterdir()] == ["out"], "left by a killed process"


def test_fault_71_kill_at_every_rename_of_a_first_result(tmp_path):
    states = kill_everywhere(tmp_path, lambda out: out.parent.mkdir())
    found = [content(out) if out.exists() else {} for out in states]
    assert all(state in ({}, NEW) for state in found)
    assert found[-1] == NEW


def test_fault_71_kill_keeps_what_else_is_in_the_folder(tmp_path):
    def prepare(out):
        write(out, "old")
        (out / "notes.txt").write_text("mine")
        (out / "jobs").mkdir()
        (out / "jobs" / "1.json").write_text("{}")

    other = {"notes.txt": "mine", "jobs/1.json": "{}"}
    for out in kill_everywhere(tmp_path, prepare, kept=("jobs",)):
        assert content(out) in (OLD | other, NEW | other)


def test_fault_71_kill_in_a_folder_that_cannot_be_exchanged_never_mixes_two_results(tmp_path):
    """With folders of others in it files move one by one: a kill may leave an incomplete result, never a mixture."""

    def prepare(out):
        write(out, "old")
        (out / "others").mkdir()
        (out / "others" / "file").write_text("mine")

    states = kill_everywhere(tmp_path, prepare)
    incomplete = 0
    for out in states:
        found = content(out)
        assert found.pop("others/file") == "mine"
        assert found.items() <= OLD.items() or found.items() <= NEW.items()
        incomplete += found not in (OLD, NEW)
        with pytest.raises(OutputError), atomic_folder(out, own=(*NAMES, "d")):
            raise OSError("the next writer fails too")
        assert {n: t for n, t in content(out).items() if n != "others/file"} in (OLD, NEW), "not settled"
        write(out, "third")
        assert set(content(out).values()) == {"third", "mine"}
        assert not [name for name in os.listdir(out) if name.startswith(".")]
    assert incomplete > 2


def test_without_an_exchange_by_the_file_system_an_error_takes_all_back(tmp_path, monkeypatch):
    out = tmp_path / "out"
    write(out, "old")
    monkeypatch.setattr(atomic, "_exchange", lambda *_: False)
    write(out, "new", optional=False)
    assert content(out) == NEW
    real, count = Path.replace, 0

    def fails_once(self, target):
        nonlocal count
        count += 1
        if count == 5:
            raise OSError(5, "Input/output error")
        return real(self, target)

    monkeypatch.setattr(Path, "replace", fails_once)
    with pytest.raises(OutputError, match="Input/output error"):
        write(out, "third")
    assert content(out) == NEW
    assert os.listdir(tmp_path) == ["out"]


def _write_often(out, content, times):
    for _ in range(times):
        write(out, content)


def test_two_writers_never_mix(tmp_path):
    out = tmp_path / "out"
    write(out, "0")
    context = multiprocessing.get_context("fork")
    children = [context.Process(target=_write_often, args=(out, str(k), 40)) for k in (1, 2)]
    for child in children:
        child.start()
    seen = set()
    while any(child.is_alive() for child in children):
        handle = os.open(out, os.O_RDONLY)  # one folder, whatever takes its name meanwhile
        texts = []
        for name in (*NAMES, "d"):
            try:
                with open(os.open(name, os.O_RDONLY, dir_fd=handle)) as file:
                    texts.append(file.read())
            except FileNotFoundError:  # it was replaced and is being deleted
                texts.append(None)
        os.close(handle)
        seen.add(frozenset(texts) - {None})
    assert [child.exitcode for child in children] == [0, 0]
    assert all(len(texts) <= 1 for texts in seen)
    assert len(set(content(out).values())) == 1
    assert os.listdir(tmp_path) == ["out"]


def test_living_writer_keeps_its_temporary_folder(tmp_path):
    out = tmp_path / "out"
    with atomic_folder(out) as slow:
        (slow / "a").write_text("slow")
        write(out, "quick")
        assert slow.is_dir()
    assert content(out)["a"] == "slow"


def test_no_link_is_followed_and_names_cannot_be_guessed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / f".a.{os.getpid()}.partial").symlink_to(victim)
    (tmp_path / "a").symlink_to(victim)
    with atomic_file(tmp_path / "a") as file:
        names = [name for name in os.listdir(tmp_path) if name.endswith(".partial") and str(os.getpid()) not in name]
        file.write("new")
    assert victim.read_text() == "precious"
    assert (tmp_path / "a").read_text() == "new"
    assert not (tmp_path / "a").is_symlink()
    assert len(names) == 1
    assert len(names[0]) > 20


def test_file_left_by_a_killed_writer_is_removed(tmp_path):
    (tmp_path / ".a.b7.partial").write_text("half")
    (tmp_path / ".ab.b7.partial").write_text("of another file")
    with atomic_file(tmp_path / "a") as file:
        file.write("new")
    assert sorted(os.listdir(tmp_path)) == [".ab.b7.partial", "a"]


def test_rights_are_those_of_the_umask_and_of_the_old_folder(tmp_path):
    old = os.umask(0o027)
    try:
        write(tmp_path / "out", "1")
        with atomic_file(tmp_path / "file") as file:
            file.write("x")
    finally:
        os.umask(old)
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o640
    (tmp_path / "out").chmod(0o775)
    write(tmp_path / "out", "2")
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o775


def test_link_to_a_folder_stays_one(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    write(tmp_path / "link", "1")
    assert (tmp_path / "link").is_symlink()
    assert content(tmp_path / "real")["a"] == "1"


def test_working_folder_is_not_taken_away(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path(), "1")
    assert content(Path())["a"] == "1"
    assert os.path.samefile(".", tmp_path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_in_a_parent_that_cannot_be_written(tmp_path):
    out = tmp_path / "out"
    write(out, "old")
    tmp_path.chmod(0o555)
    try:
        write(out, "new", optional=False)
        assert content(out) == NEW
    finally:
        tmp_path.chmod(0o755)


def test_kernel_that_refuses_to_write_keeps_the_old_file(tmp_path):
    """A limit on the size of files is a write that the kernel refuses, whatever our code calls."""
    (tmp_path / "a").write_text("old")
    code = (
        "import resource, sys; from pathlib import Path; from fgloc.files.outputs import write_text\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: write_text(Path(sys.argv[1]), 'x' * 10000)\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a")], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("OutputError")
    assert "File too large" in done.stdout
    assert (tmp_path / "a").read_text() == "old"
    assert os.listdir(tmp_path) == ["a"]
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 1000


@pytest.mark.parametrize(("out", "said"), [("file", "file"), ("file/out", "file/out: {}/file "), ("a\0b", "NUL")])
def test_out_is_checked_before_the_run(tmp_path, out, said):
    (tmp_path / "file").write_text("")
    with refusal(OutputError, said.format(tmp_path)):
        check_out(tmp_path / out)


def test_what_is_not_there_is_not_said_to_be_kept():
    with pytest.raises(OutputError, match=r"^/proc/x: [^()]+ \([^()]+\)") as refused:
        check_out(Path("/proc/x"))
    assert "kept" not in str(refused.value)


def test_out_that_can_be_written_leaves_no_trace(tmp_path):
    check_out(tmp_path / "new" / "deep")
    check_out(tmp_path / "map.yaml", folder=False)
    assert os.listdir(tmp_path) == []
    with refusal(OutputError, tmp_path):
        check_out(tmp_path, folder=False)
