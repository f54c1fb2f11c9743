"""Settings that users write: every mistake and every attack is one error with file, line and key, and quick."""

import os
import time
from collections import Counter
from pathlib import Path

import pytest
import yaml
from pydantic_core import to_jsonable_python
from refusal import refusal

from fgloc.ablation.suite import expand, load_suite
from fgloc.config import Config, config_of, load_config, setting
from fgloc.errors import ConfigError, FglocError, MapError, TrajectoryError
from fgloc.files.documents import HostileError, parse, plain
from fgloc.files.outputs import read_tum
from fgloc.files.settings import level_of, section_of
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
    assert len(list(numeric_keys())) > 75
    for name, text in numeric_cases((".nan", ".inf", "-.inf", "1e300", "-1e300")):
        with pytest.raises(ConfigError, match=name.split()[0]):
            load_config(write(text))


def test_every_default_is_within_its_bounds():
    data = Config().model_dump()
    assert Config.model_validate(data) == Config()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wheels:\n  track: 0.3\n  trak: 0.4\n", r"robot.yaml:3: wheels.trak: .*'track'"),
        ("gyro: {}\nwheel: {track: 0.3}\n", r"robot.yaml:2: wheel: .*'wheels'"),
        ("wheels:\n  scale_omega: 0\n", r"robot.yaml:1: wheels: .*scale_omega is 0, expected 0.001 or more"),
        ("wheels:\n  source: tick\n", r"robot.yaml:2: wheels.source: .*'auto', 'twist'"),
        (
            "expert:\n wheels:\n  noise:\n    x_per_sqrt_mm: 1\n",
            r"robot.yaml:4: expert.wheels.noise.x_per_sqrt_mm: .*'x_per_sqrt_m'",
        ),
        ("expert:\n gate:\n\n  max_speed: fast\n", r"robot.yaml:4: expert.gate.max_speed: .*'fast'"),
        ("wheels: {source: tick}\n", r"^\S*robot.yaml:1: wheels.source: .*'ticks'\? .*'tick'"),
        ("wheels: 3\n", r"robot.yaml:1: wheels: .*\b3\b"),
        ("expert: {motion: {use: perhaps}}\n", r"robot.yaml:1: expert.motion.use: .*true.*false"),
        ("size: 0.2\nlandmarks:\n- {id: 0}\n", r"robot.yaml.* --map"),
        ("a: 1\na: 2\n", r"robot.yaml:2: .*'a'"),
        ("x: !!int ''\n", r"robot.yaml:1: ''.*\bint\b"),
    ],
)
def test_errors_name_line_key_and_correction(write, text, said):
    with pytest.raises(ConfigError, match=said):
        load_config(write(text))


def values(model=Config, place=()):
    """Place, level and default of every value."""
    for name, field in model.model_fields.items():
        section = section_of(field)
        if section is None:
            yield (*place, name), level_of(field), to_jsonable_python(field.default)
        else:
            yield from values(section, (*place, name))


def nested(place, value):
    for key in reversed(place):
        value = {key: value}
    return yaml.safe_dump(value)


def test_every_value_is_refused_where_it_is_not_with_what_replaces_it(write):
    counts = Counter(level for _, level, _ in values())
    assert counts["user"] <= 46
    assert counts["expert"] < 80
    for place, level, default in values():
        name = ".".join(place)
        here, there = (("expert", *place), place) if level == "user" else (place, ("expert", *place))
        refused = [here, there] if level == "constant" else [here]
        for wrong in refused:
            with pytest.raises(ConfigError) as caught:
                load_config(write(nested(wrong, default)))
            said = str(caught.value)
            assert f"robot.yaml:{len(wrong)}: {'.'.join(wrong)} is" in said
            if level == "constant":
                assert "remove the line" in said
                continue
            assert f"is now {'.'.join(there)}; write\n" in said
            load_config(write(said.partition("; write\n")[2]))
        if level != "constant":
            assert setting(name) == ".".join(there)
            load_config(write(nested(there, default)))


def test_many_misplaced_values_are_replaced_by_one_block(write):
    text = (
        "wheels: {hold_s: 0.3, track: 0.2}\ngate: {max_variance: 3, max_speed: 2}\nexpert: {wheels: {delay_s: 0.1}}\n"
    )
    with pytest.raises(ConfigError) as caught:
        load_config(write(text))
    lines = str(caught.value).splitlines()
    assert [line.split(": ")[1].split(" ")[0] for line in lines[1:4]] == [
        "wheels.hold_s",
        "gate.max_variance",
        "gate.max_speed",
    ]
    config = load_config(write("\n".join(lines[4:])))
    assert (config.wheels.hold_s, config.gate.max_speed) == (0.3, 2.0)
    wrong, bag = "{name: v, config: {wheels: {hold_s: 0.3}}}", write("", "a.bag")
    suite = write(f"title: t\nrecordings: [{{name: a, bag: a.bag}}]\nvariants: [{wrong}]\n", "suite.yaml")
    with pytest.raises(ConfigError, match=r"'v'.*\n.*wheels.hold_s.*expert.wheels.hold_s"):
        expand(load_suite(suite), bag.parent)


def test_suite_errors_name_line_and_correction(write):
    text = (
        "title: t\nrecordings:\n  - {name: a, bag: b}\nfailures:\n  - name: f\n    chain:\n"
        "      - {kind: darkness, gian: 0.5}\n"
    )
    with pytest.raises(ConfigError, match=r"suite.yaml:7: .*gian: .*'gain'"):
        load_suite(write(text, "suite.yaml"))
    unknown = text.replace("darkness, gian: 0.5", "darknes")
    with pytest.raises(ConfigError, match=r"^\S*suite.yaml:7: .*'darknes'.*'darkness'\?$"):
        load_suite(write(unknown, "suite.yaml"))
    many = text.replace("gian", "gain") + f"seeds: {list(range(1000))}\nvariants:\n"
    many += "".join(f"  - {{name: v{i}}}\n" for i in range(2000))
    with pytest.raises(ConfigError, match=r"\b2002000\b"):
        load_suite(write(many, "suite.yaml"))


@pytest.mark.parametrize("text", [SYNTAX[name] for name in ("alias bomb", "merge bomb", "alias chain", "deep lists")])
def test_fault_65_bombs_are_refused_by_every_reader(write, text):
    for read in (load_config, load_suite, load_map):
        path = write(text)
        with refusal(FglocError, path, cause=HostileError):
            read(path)


def test_harmless_aliases_are_followed():
    node = parse("a: &x {p: 1, q: [1, 2]}\nb: *x\nc: {<<: *x, p: 5}\nd: {<<: [{r: 1}, *x]}\n", "t")
    x = {"p": 1, "q": [1, 2]}
    assert plain(node) == {"a": x, "b": x, "c": x | {"p": 5}, "d": x | {"r": 1}}


def test_sections_whose_keys_are_all_comments_are_empty(write):
    """As `fgloc init` writes them where a recording has no topic of a role."""
    text = "wheels:\n  # scale_v: 1.0\nrecording:\n  topics:\n    # odometry:\n"
    assert load_config(write(text)) == config_of({})


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
    endless = [Path("/dev/zero")] if os.path.exists("/dev/zero") else []
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "a\0b", tmp_path / ("a" * 300), *endless):
        with pytest.raises((ConfigError, MapError, TrajectoryError)) as caught:
            read(path)
        assert path.name in str(caught.value).replace("\\x00", "\0")


def test_dictionary_file_that_never_ends_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.yml")
    with refusal(ConfigError, tmp_path / "pipe.yml"):
        load_dictionary(str(tmp_path / "pipe.yml"))


def test_a_line_that_is_indented_by_a_tab_is_named(write):
    with pytest.raises(ConfigError, match=r"robot\.yaml.*line 3 .*\btab\b"):
        load_config(write("wheels:\n  scale_v: 1.0\n\tscale_w: 1.0\n"))


def test_white_space_within_a_line_is_not_taken_for_the_mistake(write):
    with pytest.raises(ConfigError) as refused:
        load_config(write('wheels:\n  scale_v:\t"1.0\n'))
    assert "tab" not in str(refused.value)
