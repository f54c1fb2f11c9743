"""Settings that users write: every mistake and every attack is one error with file, line and key, and quick."""

import os
import time

import pytest
import yaml

from fgloc.ablation.suite import load_suite
from fgloc.config import Config, load_config
from fgloc.errors import ConfigError, FglocError, MapError, TrajectoryError
from fgloc.files.documents import HostileError, parse, plain
from fgloc.files.outputs import read_tum
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers.detector import load_dictionary
from tests.fuzz.hostile_yaml import SYNTAX, numeric_cases, numeric_keys

ACCEPTED = {"date", "date of year 0", "long float", "escaped NUL", "no noise at all", "topic of control characters"}
ACCEPTED |= {"nothing", "null", "a comment"}
FILES = {name for name in SYNTAX if name.split()[0] in ("NUL", "pipe", "endless", "folder")} | {"long path"}


@pytest.fixture
def write(tmp_path):
    def made(text, name="robot.yaml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return made


def test_fault_65_hostile_configurations_are_refused_in_time(write):
    accepted = set()
    for name, text in SYNTAX.items():
        began = time.process_time()
        path = write(text)
        try:
            load_config(path)
        except ConfigError as error:
            said = str(error)
        else:
            said = str(path)
            accepted.add(name)
        assert str(path) in said, name
        assert time.process_time() - began < 2.0, name
    assert accepted == ACCEPTED | FILES


def test_not_a_number_and_infinity_are_refused_everywhere(write):
    assert len(list(numeric_keys())) > 90
    for name, text in numeric_cases((".nan", ".inf", "-.inf", "1e300", "-1e300")):
        with pytest.raises(ConfigError, match=name.split()[0]):
            load_config(write(text))


def test_every_default_is_within_its_bounds():
    data = Config().model_dump()
    assert Config.model_validate(data) == Config()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wheels:\n  track: 0.3\n  trak: 0.4\n", r"robot.yaml:3: wheels.trak: unknown key; did you mean 'track'\?"),
        ("gyro: {}\nwheel: {track: 0.3}\n", r"robot.yaml:2: wheel: unknown key; did you mean 'wheels'\?"),
        ("wheels:\n  source: tick\n", r"robot.yaml:2: wheels.source: expected 'auto', 'twist'"),
        ("wheels:\n  noise:\n    x_per_sqrt_mm: 1\n", r"robot.yaml:3: wheels.noise.x_per_sqrt_mm.*'x_per_sqrt_m'\?"),
        ("gate:\n\n  max_speed: fast\n", r"robot.yaml:3: gate.max_speed: .*number.*got 'fast'"),
        ("wheels: {source: tick}\n", r"^\S*robot.yaml:1: wheels.source: .*; did you mean 'ticks'\?"),
        ("wheels: 3\n", r"robot.yaml:1: wheels: expected keys with values \(got 3\)"),
        ("motion: {use: perhaps}\n", r"robot.yaml:1: motion.use: expected true or false"),
        ("size: 0.2\nlandmarks:\n- {id: 0}\n", r"robot.yaml is a map, .* --map"),
        ("a: 1\na: 2\n", r"robot.yaml:2: key 'a' is given twice"),
        ("x: !!int ''\n", r"robot.yaml:1: '' is not a value of kind int"),
    ],
)
def test_errors_name_line_key_and_correction(write, text, said):
    with pytest.raises(ConfigError, match=said):
        load_config(write(text))


def test_suite_errors_name_line_and_correction(write):
    text = (
        "title: t\nrecordings:\n  - {name: a, bag: b}\nfailures:\n  - name: f\n    chain:\n"
        "      - {kind: darkness, gian: 0.5}\n"
    )
    with pytest.raises(ConfigError, match=r"suite.yaml:7: .*gian: unknown key; did you mean 'gain'\?"):
        load_suite(write(text, "suite.yaml"))
    unknown = text.replace("darkness, gian: 0.5", "darknes")
    with pytest.raises(
        ConfigError, match=r"^\S*suite.yaml:7: \S*: there is no kind 'darknes'; did you mean 'darkness'\?$"
    ):
        load_suite(write(unknown, "suite.yaml"))
    many = text.replace("gian", "gain") + f"seeds: {list(range(1000))}\nvariants:\n"
    many += "".join(f"  - {{name: v{i}}}\n" for i in range(2000))
    with pytest.raises(ConfigError, match="asks for 2002000 runs"):
        load_suite(write(many, "suite.yaml"))


@pytest.mark.parametrize("text", [SYNTAX[name] for name in ("alias bomb", "merge bomb", "alias chain", "deep lists")])
def test_fault_65_bombs_are_refused_by_every_reader(write, text):
    for read in (load_config, load_suite, load_map):
        with pytest.raises(FglocError, match=r"stand for more|nested deeper"):
            read(write(text))


def test_harmless_aliases_are_followed():
    node = parse("a: &x {p: 1, q: [1, 2]}\nb: *x\nc: {<<: *x, p: 5}\nd: {<<: [{r: 1}, *x]}\n", "t")
    x = {"p": 1, "q": [1, 2]}
    assert plain(node) == {"a": x, "b": x, "c": x | {"p": 5}, "d": x | {"r": 1}}


def test_sections_whose_keys_are_all_comments_are_empty(write):
    """As `fgloc init` writes them where a recording has no topic of a role."""
    text = "wheels:\n  # scale_v: 1.0\nrecording:\n  topics:\n    # odometry:\n"
    assert load_config(write(text)) == Config()


def test_values_are_those_of_yaml():
    text = "[1, 0x1f, 1_000, 1.5, .5, 1e3, yes, off, ~, null, '', word, 2024-01-31, \"1\", !!str 1, !!float 1]"
    assert plain(parse(text, "t")) == [
        *(1, 31, 1000, 1.5, 0.5, "1e3", True, False, None, None, "", "word", "2024-01-31", "1", "1", 1.0)
    ]
    usual = yaml.safe_load(text)
    assert [v for v in plain(parse(text, "t")) if v != "2024-01-31"] == [v for v in usual if not hasattr(v, "year")]
    with pytest.raises(HostileError):
        parse("[" * 100, "t")


@pytest.mark.parametrize("read", [load_config, load_suite, load_map, read_tum])
def test_only_regular_files_are_read(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "a\0b", tmp_path / ("a" * 300)):
        with pytest.raises((ConfigError, MapError, TrajectoryError)):
            read(path)
    if os.path.exists("/dev/zero"):
        from pathlib import Path

        with pytest.raises(FglocError, match="not a regular file"):
            read(Path("/dev/zero"))


def test_dictionary_file_that_never_ends_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.yml")
    with pytest.raises(ConfigError, match="not a regular file"):
        load_dictionary(str(tmp_path / "pipe.yml"))
