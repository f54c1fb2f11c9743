"""What a new user meets: help, version, missing extras, progress on a pipe, Ctrl-C, the first steps with a robot."""

import contextlib
import json
import math
import os
import pty
import re
import select
import shlex
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import yaml
from circle_bag import write_circle
from command_line import fgloc
from typer.main import get_command

from fgloc import instrumentation as progress
from fgloc.cli import app, options
from fgloc.cli.terminal import LINE_S, Lines
from fgloc.config import Config, WheelsConfig, config_of, load_config
from fgloc.evaluation.metrics import all_findings, compute_metrics
from fgloc.recording.info import inspect
from fgloc.runner import run
from fgloc.sensors.maps import load_map, write_map
from fgloc.types import Decision, Finding, Severity, ordered
from fgloc_datasets.bag import BagWriter
from fgloc_training.config import load_train_config
from fgloc_training.recordings import Found, missing

START_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_circle(tmp_path_factory.mktemp("circle"), seconds=5.0)


# --- help and version -------------------------------------------------------------------------------------------------


def test_python_dash_m_and_version():
    done = subprocess.run([sys.executable, "-m", "fgloc", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"fgloc {version('fgloc')}\n")


@pytest.mark.parametrize("command", [(), ("train",), ("sim",), ("sim", "record"), ("convert", "mrclam"), ("init",)])
def test_short_help(command):
    code, out, _ = fgloc(*command, "-h")
    assert code == 0
    assert "Usage: " in out


def test_the_lists_of_commands_show_whole_sentences():
    for group in ((), ("sim",), ("convert",)):
        listed = fgloc(*group, "-h")[1].partition("Commands:")[2].strip().splitlines()
        assert all(line.endswith(".") and not line.endswith("..") for line in listed), listed


@pytest.mark.parametrize("name", sorted(get_command(app).commands))
def test_examples_of_a_command_are_understood(name):
    command = get_command(app).commands[name]
    examples = re.findall(r"^ +fgloc ([^#\n]+)", command.epilog or "", re.MULTILINE)
    assert examples or hasattr(command, "commands")
    for example in examples:
        first, *arguments = shlex.split(example)
        assert first == name
        with command.make_context(name, arguments) as context:
            assert context.params


def below(command, words=()):
    """Every command that is no group, by the words that lead to it."""
    if not hasattr(command, "commands"):
        yield words, command
    for name, part in getattr(command, "commands", {}).items():
        yield from below(part, (*words, name))


@pytest.mark.parametrize("words", [words for words, _ in below(get_command(app))], ids=" ".join)
def test_help_has_examples_and_names_values_as_they_are_typed(words):
    code, out, _ = fgloc(*words, "--help")
    assert code == 0
    assert f"  fgloc {' '.join(words)}" in out.partition("Examples:")[2]
    usage = out.partition("\n")[0]
    assert not re.search(r"[{}]|\.{4}", usage), usage
    assert not re.findall(r"<(?:list|int|float|str|path|Path)\b", out)
    assert max(map(len, out.splitlines())) > 50
    known = dict(below(get_command(app)))[words]
    for example in re.findall(r"^ +fgloc ([^#\n]+)", known.epilog, re.MULTILINE):
        arguments = shlex.split(example)[len(words) :]
        with known.make_context(words[-1], arguments) as context:
            assert context.params


def test_help_is_as_wide_as_the_terminal():
    command = [sys.executable, "-m", "fgloc", "smooth", "-h"]
    done = subprocess.run(command, env=os.environ | {"COLUMNS": "110"}, capture_output=True, text=True, check=True)
    assert 80 < max(map(len, done.stdout.splitlines())) <= 110


def test_completion_is_offered():
    assert "--install-completion" in fgloc("--help")[1]


# --- extras -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extra", "command"),
    [
        ("train", ("train", "c.yaml", "--out", "models")),
        ("sim", ("sim", "record", "calibrated", "--out", "run")),
        ("sweep", ("ablate", "suite.yaml", "--out", "swept")),
        ("live", ("live",)),
        ("live", ("play", "bag")),
        ("view", ("live", "--view")),
    ],
)
def test_a_missing_extra_is_named_with_its_remedy(extra, command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    there = options.find_spec
    absent = options._NEEDED[extra]
    monkeypatch.setattr(options, "find_spec", lambda name: None if name in absent else there(name))
    code, out, err = fgloc(*command)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert f"-m pip install 'fgloc[{extra}]'" in err
    assert all(name in err for name in absent)
    assert not list(tmp_path.iterdir())


# --- progress ---------------------------------------------------------------------------------------------------------


def test_a_pipe_gets_a_line_every_ten_seconds_with_the_time_left():
    now, lines = [0.0], []
    listener = Lines(lines.append, lambda: now[0])
    with progress.told_to(listener):
        for done in range(61):
            now[0] = 0.5 * done
            progress.tell("batch", done, 60.0, "s")
        progress.end("batch")
    assert lines == ["batch: 20 of 60 s (33 %), 20 s left", "batch: 40 of 60 s (67 %), 10 s left"]
    assert LINE_S == 10.0


def test_no_time_left_is_told_of_work_that_has_just_begun():
    now, lines = [0.0], []
    with progress.told_to(Lines(lines.append, lambda: now[0])):
        now[0] = 12.0  # imports took long
        progress.tell("batch", 0, 60.0, "s")
        now[0] = 12.01
        progress.tell("batch", 0.2, 60.0, "s")
        now[0] = 14.0
        progress.tell("batch", 20.0, 60.0, "s")
    assert lines == ["batch: 20 of 60 s (33 %), 4 s left"]


def test_the_time_left_of_resumed_work_is_of_what_was_done_now():
    now, lines = [0.0], []
    with progress.told_to(Lines(lines.append, lambda: now[0])):
        progress.tell("mean", 900, 1000, "iterations")
        now[0] = 10.0
        progress.tell("mean", 950, 1000, "iterations", "validation 3.2")
    assert lines == ["mean: 950 of 1000 iterations (95 %), validation 3.2, 10 s left"]


def test_a_run_tells_when_it_checks_and_smooths_and_ends_at_its_end(bag, tmp_path):
    told = []
    with progress.told_to(told.append):
        run(bag, None, config_of({}), "batch", lambda done, total: progress.tell("batch", done, total))
    labels = list(dict.fromkeys(advance.label for advance in told))
    assert labels == ["checking", "batch", "smoothing"]
    last = [advance for advance in told if advance.label == "batch"][-1]
    assert last.done == last.total


def test_nobody_listens_by_default_and_counting_ends():
    told = []
    assert list(progress.counted("abc", "letters", 3)) == ["a", "b", "c"]
    with progress.told_to(told.append):
        list(progress.counted("abc", "letters", 3))
    assert [a.done for a in told] == [1, 2, 3, 0]
    assert told[-1].ended


def test_ctrl_c_says_what_is_kept(bag, tmp_path, monkeypatch):
    calls = []

    def interrupt(listener, advance):
        calls.append(advance)
        if len(calls) == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Lines, "__call__", interrupt)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a test of `fgloc live` may have left its own
    try:
        code, out, err = fgloc("online", bag, "--out", tmp_path / "out")
    finally:
        signal.signal(signal.SIGINT, before)
    assert code == 130
    assert all(line.startswith(("map:", "configuration:")) for line in out.splitlines())  # no result is told
    assert err.startswith("interrupted: ")
    assert len(err.splitlines()) == 1
    assert 0.0 <= calls[1].done < 5.0
    assert not (tmp_path / "out").exists()


def test_ctrl_c_after_the_result_was_written_says_that_it_is_whole(bag, tmp_path, monkeypatch):
    monkeypatch.setattr("fgloc.cli.runs.say_table", lambda *_: signal.raise_signal(signal.SIGINT))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code, _, err = fgloc("online", bag, "--out", tmp_path / "out")
    finally:
        signal.signal(signal.SIGINT, before)
    assert code == 130
    assert err.startswith("interrupted: ")
    assert str(tmp_path / "out") in err
    assert (tmp_path / "out" / "report.html").is_file()


# --- findings ---------------------------------------------------------------------------------------------------------


def test_the_gravest_finding_comes_first(bag):
    result = run(bag, bag.parent / "map.yaml", Config(), "online")
    assert result.truth is not None
    metrics = compute_metrics(result, Config())
    assert {f.severity for f in metrics.findings} <= {"note"}
    noted = replace(
        result,
        findings=(
            Finding("run", "Nothing special."),
            Finding("setup", "The camera is upside down.", Severity.ERROR),
            Finding("clock", "The truth is in another frame than the map.", Severity.WARNING),
        ),
    )
    said = all_findings(noted, 9.0, {"image.dark": 40, "odometry.order": 2}, metrics.keyframes)
    assert [f.code for f in said] == ["setup", "clock", "covariance.optimistic", "image.dropped", "run"]
    assert said[2].value == 9.0
    assert "raise map.position_sigma_m or " in said[2].text
    assert all(name in said[2].text for name in ("landmarks.range_scale_sigma", "wheels.scale_sigma"))
    assert "camera." not in said[2].text  # there is none
    assert said[3].value == 40


def test_when_the_robot_was_lifted_is_told_by_one_source(bag):
    result = run(bag, bag.parent / "map.yaml", Config(), "online")
    start, nan = int(result.trajectory.stamps_ns[0]), math.nan
    lifts = tuple(
        Decision(k, start + round(k * 1e8), "lift", -1, nan, 100.0, 3, 0.0, "tilted", 26.0) for k in range(12, 25)
    )
    told = (Finding("motion.lifted", "The robot was lifted from 1.5 to 2.2 s.", Severity.WARNING, value=1.5),)
    lifted = replace(result, findings=told, decisions=(*result.decisions, *lifts))
    metrics = compute_metrics(lifted, Config())
    (judged,) = [j for j in metrics.judgements if j.kind == "lifted"]
    (finding,) = [f for f in metrics.findings if f.code == "motion.lifted"]
    assert finding.value == judged.from_s
    assert judged.when in finding.text
    (kept,) = [f for f in compute_metrics(replace(result, findings=told), Config()).findings if f.code == told[0].code]
    assert kept.value == 1.5


def test_one_line_is_given_for_each_key():
    said = ordered(
        [
            Finding("a", "first", Severity.WARNING, {"landmarks.range_scale": "0.92"}),
            Finding("b", "second", Severity.WARNING, {"landmarks.range_scale": "0.96"}),
            Finding("c", "first", Severity.NOTE),
        ]
    )
    assert [f.code for f in said] == ["a"]


# --- a robot of your own ----------------------------------------------------------------------------------------------

RADIUS, TRACK = 0.08, 0.4


def write_robot(path, seconds=8.0, truth=False):
    """A robot with wheels and odometry that turns to and fro; its wheels' names are its own."""
    with BagWriter(path) as bag:
        pose, angles = np.zeros(3), np.zeros(2)
        for k in range(round(seconds * 50)):
            stamp = START_NS + k * 20_000_000
            v, omega = 0.4, 0.5 * np.sin(0.02 * k)
            pose = pose + 0.02 * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), omega])
            angles = angles + 0.02 * np.array([v - omega * TRACK / 2, v + omega * TRACK / 2]) / RADIUS
            bag.odometry("/odom", stamp, pose, (v, omega))
            bag.joints("/joint_states", stamp, ("arm", "wheel_left", "wheel_right"), [0.0, *angles])
            bag.command("/cmd_vel", stamp, v, omega)
            if truth:
                bag.planar_truth("/truth", stamp, pose)
    return path


def test_init_finds_topics_wheels_and_says_what_is_missing(tmp_path):
    bag = write_robot(tmp_path / "bags" / "run1")
    file = tmp_path / "bags" / "robot.yaml"
    code, out, err = fgloc("init", bag, "--out", file)
    assert code == 0
    config = load_config(file)
    assert config.recording.topics.odometry == "/odom"
    assert config.recording.topics.command == "/cmd_vel"
    assert config.recording.topics.truth is None
    assert isinstance(config.wheels, WheelsConfig)
    assert (config.wheels.left_joint, config.wheels.right_joint) == ("wheel_left", "wheel_right")
    assert config.wheels.left_radius == pytest.approx(RADIUS, rel=0.01)
    assert config.wheels.track == pytest.approx(TRACK, rel=0.01)
    codes = {f.code: f.text for f in inspect(bag, Config()).found}
    assert "warning: no truth" in err
    assert codes["place.unbounded"] in err
    assert f"next: fgloc info {bag}" in out
    assert "next: fgloc map" not in out  # there is nothing to survey
    before = file.read_text()
    assert "# sightings:  # not found" in before
    code, _, err = fgloc("init", bag, "--out", file)
    assert (code, file.read_text()) == (1, before)
    assert "--force" in err
    assert fgloc("init", bag, "--out", file, "--force")[0] == 0


def test_init_of_a_recording_without_a_known_topic_writes_settings_and_exits_with_1(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.flag("/lights", True, START_NS)
        bag.flag("/lights", False, START_NS + 10**9)
    file = tmp_path / "robot.yaml"
    code, _, err = fgloc("init", tmp_path / "bag", "--out", file)
    assert code == 1
    codes = {f.code: f.text for f in inspect(tmp_path / "bag", Config()).found}
    assert codes["motion.unmeasured"] in err
    assert load_config(file) == config_of({})


def test_init_of_sightings_alone_leads_to_a_survey(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(60):
            bag.range_bearing("/landmarks", START_NS + k * 50_000_000, [(0, 2.0, 0.0)])
    code, out, err = fgloc("init", tmp_path / "bag", "--out", tmp_path / "robot.yaml")
    assert code == 0, err
    assert "next: fgloc map" in out


def write_joints(path):
    """A recording without odometry: the geometry of the wheels is not in it."""
    with BagWriter(path) as bag:
        for k in range(60):
            stamp = START_NS + k * 50_000_000
            bag.joints("/joint_states", stamp, ("wheel_left", "wheel_right"), [0.1 * k, 0.12 * k])
            bag.range_bearing("/landmarks", stamp, [(0, 2.0, 0.0)])
    return path


def at_a_terminal(answers, *arguments):
    """Exit code and output of a command whose input, output and errors are a terminal, with a line for each prompt.

    Python hears no signal between the prompt and its wait for a line (13 of 300 under load): Ctrl-C is pressed again.
    """
    pid, terminal = pty.fork()
    if pid == 0:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell's background job ignores it
        os.execv(sys.executable, [sys.executable, "-m", "fgloc.cli", *map(str, arguments)])
    out, answers, given, quiet_s = b"", [*answers], b"", 0
    with contextlib.suppress(OSError):  # the terminal is closed at the end
        while quiet_s < 60:
            if not select.select([terminal], [], [], 1.0)[0]:
                quiet_s += 1
                if given == b"\x03" and quiet_s % 10 == 0:  # one while Python ends would kill it
                    os.write(terminal, given)
                continue
            data, quiet_s = os.read(terminal, 4096), 0
            out += data
            if answers and out.endswith(b"]: "):
                given = answers.pop(0).encode()
                os.write(terminal, given)
                out += b"<"
        os.kill(pid, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), out.decode()


def test_init_asks_at_a_terminal_for_what_the_recording_does_not_tell(tmp_path):
    bag = write_joints(tmp_path / "bags" / "run1")
    code, out = at_a_terminal(["5 cm\n", "0,05\n", "0.3\n"], "init", bag)
    assert code == 0
    assert "'5 cm'" in out
    assert "radii and track" in out  # what it asks for
    assert "warning: radii" not in out
    wheels = load_config(tmp_path / "bags" / "robot.yaml").wheels  # where other commands read it
    assert (wheels.source, wheels.left_joint, wheels.right_joint) == ("ticks", "wheel_left", "wheel_right")
    assert (wheels.left_radius, wheels.right_radius, wheels.track) == (0.05, 0.05, 0.3)
    assert f"next: fgloc info {bag} " in out
    assert "--config" not in out


def test_what_enter_leaves_open_is_still_to_be_filled_in(tmp_path):
    bag = write_joints(tmp_path / "bags" / "run1")
    code, out = at_a_terminal(["0.05\n", "\n"], "init", bag, "--out", tmp_path / "robot.yaml")
    assert code == 0
    assert "radii and track" in out.partition("configuration:")[0].rpartition("warning:")[2]
    assert "#   left_radius:   # m" in (tmp_path / "robot.yaml").read_text()
    assert f"--config {tmp_path / 'robot.yaml'}" in out
    code, out = at_a_terminal(["\x03"], "init", bag, "--out", tmp_path / "other.yaml")
    assert (code, (tmp_path / "other.yaml").exists()) == (130, False)


@pytest.mark.parametrize("unset", [False, True])
def test_init_takes_receive_times_for_stamps_of_another_clock(tmp_path, unset):
    """An odometry that is stamped days before it is received, as the Pioneer's, and markers whose driver sets none."""
    path, late = tmp_path / "run" / "bag", 14 * 86_400 * 10**9
    with BagWriter(path) as bag:
        for k in range(40):
            stamp = START_NS + k * 50_000_000
            bag.odometry("/odom", stamp - late, np.zeros(3), (0.0, 0.0), received_ns=stamp)
            bag.range_bearing("/landmarks", 0 if unset else stamp, [(0, 2.0, 0.0)], received_ns=stamp)
            bag.truth("/truth", stamp, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    file = tmp_path / "robot.yaml"
    code, out, err = fgloc("init", path, "--out", file)
    config = load_config(file)
    assert code == 0
    assert config.recording.received_stamps == (("odometry", "sightings") if unset else ("odometry",))
    assert re.search(r"^warning: .*\bodometry\b.* clock\b", err, re.MULTILINE)
    assert config.truth.align == "se2"  # no map beside the bag: a survey begins at the first pose
    assert f"next: fgloc map {path}" in out


def test_a_training_configuration_is_split_by_recording(tmp_path):
    bags = [write_robot(tmp_path / "bags" / f"run{i}", 8.0 + 0.02 * i, truth=True) for i in range(4)]
    file = tmp_path / "train.yaml"
    code, out, err = fgloc("train", "--init", *bags, "--out", file)
    assert code == 0
    config = load_train_config(file)
    assert config.split is not None
    assert config.split.train == ("run0", "run1")
    assert (config.split.validation, config.split.test) == (("run2",), ("run3",))
    assert (tmp_path / config.recordings["run3"]).resolve() == bags[3].resolve()
    assert config.limits is not None
    assert config.limits.v_mps == pytest.approx(0.4)
    assert "0.5 min" in err
    assert f"next: fgloc train {file} --out models" in out


@pytest.mark.parametrize("kind", ["mecanum", "ackermann"])
def test_a_training_configuration_reads_what_the_drive_is_commanded(tmp_path, kind):
    """Speeds to the side of a drive that goes there, yaw rates of one that is commanded by a steering angle."""
    shape = {
        "mecanum": "wheels: [a, b, c, d], radius: 0.05, half_sum: 0.27",
        "ackermann": "wheelbase: 0.5",
    }
    bags = []
    for i in range(3):
        folder = tmp_path / f"run{i}"
        folder.mkdir()
        (folder / "robot.yaml").write_text(f"wheels:\n  drive: {{kind: {kind}, {shape[kind]}}}\n", encoding="utf-8")
        with BagWriter(folder / "bag") as bag:
            for k in range(60 + i):
                stamp = 1_700_000_000_000_000_000 + k * 100_000_000
                if kind == "mecanum":
                    bag.command("/cmd_vel", stamp, 0.2, 0.3, vy=0.1)
                else:
                    bag.ackermann("/ackermann_cmd", stamp, 0.2, math.atan(0.5 * 0.3 / 0.2))
                bag.truth("/truth", stamp, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        bags.append(folder / "bag")
    file = tmp_path / "train.yaml"
    assert fgloc("train", "--init", *bags, "--out", file)[0] == 0
    config = load_train_config(file)
    assert config.network.inputs == (("commands", "sideways") if kind == "mecanum" else ("commands",))
    assert config.limits is not None
    assert config.limits.omega_radps == pytest.approx(0.3, rel=0.01)


def test_without_truth_the_smoothed_runs_are_the_truth(tmp_path):
    bags = [write_robot(tmp_path / f"run{i}", seconds=2.0 + i) for i in range(3)]
    file = tmp_path / "train.yaml"
    assert fgloc("train", "--init", *bags, "--out", file)[0] == 0
    content = yaml.safe_load(file.read_text())
    assert content["truth"] == {f"run{i}": f"smoothed/run{i}" for i in range(3)}


@pytest.mark.parametrize("command", [("train", "--init"), ("calibrate",)])
def test_one_recording_counts_once(tmp_path, command):
    one, other = (write_robot(tmp_path / f"run{i}", seconds=2.0 + i, truth=True) for i in range(2))
    copy = shutil.copytree(one, tmp_path / "copy")
    for again in (one, copy, next(one.glob("*.mcap"))):
        code, _, err = fgloc(*command, one, other, again, "--out", tmp_path / "written.yaml")
        assert code == 1
        assert f"{one} and {again} are the same" in err
    assert not (tmp_path / "written.yaml").exists()


def test_configurations_that_differ_may_be_of_two_robots(tmp_path):
    bags = [write_robot(tmp_path / f"run{i}" / "bag", seconds=2.0 + i) for i in range(3)]
    files = [bag.parent / "robot.yaml" for bag in bags]
    for file, track in zip(files, (0.3, 0.3, 0.4), strict=True):
        file.write_text(f"# {file}\nwheels: {{track: {track}}}\n")
    _, _, err = fgloc("train", "--init", *bags, "--out", tmp_path / "train.yaml")
    (told,) = [line for line in err.splitlines() if str(files[0]) in line]
    assert told.startswith("warning: ")
    assert str(files[2]) in told
    assert str(files[1]) not in err


@pytest.mark.parametrize(("short_s", "wanted"), [(2.9, 0), (3.1, 1)])
def test_ten_minutes_are_wanted_until_there_are_ten_as_told(short_s, wanted):
    found = [Found(Path(name), 0.5 * (600.0 - short_s), True, (0.4, 0.5, 0.0)) for name in "ab"]
    lacking = [text for text in missing(found) if "ten minutes" in text]
    assert len(lacking) == wanted
    assert all("9.9 min" in text for text in lacking)


def test_a_single_recording_or_one_without_commands_cannot_be_trained_on(tmp_path):
    bag = write_robot(tmp_path / "run", seconds=2.0)
    code, _, err = fgloc("train", "--init", bag, "--out", tmp_path / "train.yaml")
    assert code == 1
    assert re.search(r"\b1 recording\b.* 2 or more\b", err)
    code, _, err = fgloc("train", bag, bag, "--out", tmp_path / "models")
    assert code == 1
    assert "2 files" in err
    silent = write_circle(tmp_path, seconds=2.0)
    code, _, err = fgloc("train", "--init", bag, silent, "--out", tmp_path / "train.yaml")
    assert code == 1
    assert "no commands" in err
    assert not (tmp_path / "train.yaml").exists()


# --- compare ----------------------------------------------------------------------------------------------------------


def test_finished_runs_are_compared_with_each_other_and_with_the_truth(bag, tmp_path):
    for name, mode in (("a", "smooth"), ("b", "online")):
        assert fgloc(mode, bag, "--map", bag.parent / "map.yaml", "--out", tmp_path / name)[0] in (0, 3)
    code, out, _ = fgloc("compare", tmp_path / "a", tmp_path / "b", "--figure", tmp_path / "both.svg")
    assert code == 0
    head, first, second, *_ = out.splitlines()
    assert head.split()[0] == "run"
    assert (first.split()[0], second.split()[0]) == ("a", "b")
    assert first.split()[-1] == "-"
    assert 0.0 <= float(second.split()[-1]) < 0.5
    assert (tmp_path / "both.svg").read_bytes().startswith(b"<?xml")
    file = tmp_path / "a" / "config.json"
    now = json.loads(file.read_text())
    assert now["format"] == 1
    file.write_text(json.dumps({key: value for key, value in now.items() if key != "format"}))  # as before 1.0
    assert fgloc("compare", tmp_path / "a", tmp_path / "b")[1] == out.partition("figure:")[0]
    for later in (2, "x"):
        file.write_text(json.dumps(now | {"format": later}))
        for command in (("compare", tmp_path / "b", tmp_path / "a"), ("export", tmp_path / "a", "--kitti", "k.txt")):
            code, _, err = fgloc(*command)
            assert code == 1
            assert str(tmp_path / "a") in err
            assert f"(format {later!r}" in err


def test_distances_between_frames_or_recordings_are_told_as_such(bag, tmp_path):
    other = write_circle(tmp_path, seconds=5.0, start_ns=START_NS + 60_000_000_000)
    free = tmp_path / "alone" / "bag"  # without a map beside it
    free.parent.mkdir()
    free.symlink_to(bag, target_is_directory=True)
    runs = {"a": (bag, "--map", bag.parent / "map.yaml"), "free": (free,), "other": (other,)}
    for name, arguments in runs.items():
        fgloc("smooth", *arguments, "--out", tmp_path / name)
    assert fgloc("compare", tmp_path / "a", tmp_path / "a")[2] == ""
    for name in ("free", "other"):
        code, _, err = fgloc("compare", tmp_path / "a", tmp_path / name)
        assert code == 0
        assert len(err.splitlines()) == 1
        assert err.startswith(f"warning: {name} and a ")


def test_a_truth_in_another_frame_is_named_and_blames_no_covariance(tmp_path):
    bag = write_circle(tmp_path, seconds=15.0)
    (tmp_path / "map.yaml").unlink()
    for align, codes in (("none", {"truth.frame"}), ("se2", set())):
        (tmp_path / "robot.yaml").write_text(f"truth: {{align: {align}}}\n")
        assert fgloc("smooth", bag, "--out", tmp_path / align)[0] == 0
        findings = json.loads((tmp_path / align / "metrics.json").read_text())["findings"]
        assert {f["code"] for f in findings if f["severity"] != "note"} == codes
        assert [f["lines"] for f in findings if f["code"] == "truth.frame"] == [{"truth.align": "se2"}] * len(codes)


def test_a_map_in_another_frame_than_the_truth_is_named_and_blames_no_covariance(tmp_path):
    """A map that `fgloc map` made of another drive has the frame of that drive's first pose."""
    bag = write_circle(tmp_path, seconds=15.0)
    given = load_map(tmp_path / "map.yaml")
    moved = {i: replace(lm, position=lm.position + np.array([3.0, -2.0, 0.0])) for i, lm in given.landmarks.items()}
    write_map(replace(given, landmarks=moved), tmp_path / "map.yaml")
    assert fgloc("smooth", bag, "--map", tmp_path / "map.yaml", "--out", tmp_path / "moved")[0] == 0
    findings = json.loads((tmp_path / "moved" / "metrics.json").read_text())["findings"]
    told = {f["code"]: f["lines"] for f in findings if f["severity"] != "note"}
    assert told == {"truth.frame": {"truth.align": "se2"}}


def test_a_truth_whose_body_is_turned_is_named_in_a_short_run_too_and_blames_no_covariance(tmp_path):
    """The comparison before the run needs more windows than a few seconds have; the run itself shows it."""
    bag = write_circle(tmp_path, seconds=6.0)
    (tmp_path / "robot.yaml").write_text("truth: {yaw_offset_rad: -1.2}\n")
    assert fgloc("smooth", bag, "--out", tmp_path / "turned")[0] == 0
    findings = json.loads((tmp_path / "turned" / "metrics.json").read_text())["findings"]
    assert [f["code"] for f in findings if f["severity"] != "note"] == ["truth.mounting"]
    lines = {k: float(v) for f in findings if f["code"] == "truth.mounting" for k, v in f["lines"].items()}
    assert lines == {"truth.yaw_offset_rad": pytest.approx(0.0, abs=0.05)}


def test_info_names_a_map_of_other_markers(bag, tmp_path):
    (tmp_path / "map.yaml").write_text("landmarks:\n  - {id: 90, position: [1, 2]}\n  - {id: 91, position: [4, 2]}\n")
    code, out, _ = fgloc("info", bag, "--map", tmp_path / "map.yaml")
    assert code == 3
    assert "90, 91" in out
    assert fgloc("info", bag, "--map", bag.parent / "map.yaml")[0] == 0


@pytest.mark.parametrize("arguments", [("a",), ("a", "b", "--figure", "both.txt")])
def test_what_cannot_be_compared_is_a_usage_error(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    code, _, _ = fgloc("compare", *arguments)
    assert code == 2
    assert list(tmp_path.iterdir()) == []
