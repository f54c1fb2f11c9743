"""A few seconds of fuzzing on every run; ``python -m tests.fuzz --minutes N`` goes on for longer."""

import itertools
import json
import math
import os
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fgloc
from fgloc.config import GateConfig, load_config, role_names
from fgloc.errors import FglocError, ModelError
from fgloc.files.documents import parse, plain
from fgloc.intake.validation import EventValidator
from fgloc.recording.messages import default_typestore
from fgloc.recording.reader import converters_of
from fgloc.sensors.learned.sensor import load_model
from tests.fuzz import zygote
from tests.fuzz.cases import recording_cases
from tests.fuzz.mutate import MUTATIONS, mutated
from tests.fuzz.samples import SAMPLES, make_samples

REGRESSIONS = Path(__file__).parent / "regressions"
QUICK = settings(max_examples=25, deadline=2000, derandomize=True, suppress_health_check=list(HealthCheck))
STORE = default_typestore()
ROLES = [(role, kind) for role in role_names() for kind in converters_of(role)]

YAML = st.text(alphabet="abc019:-[]{}&*!|>%#'\"\n\t ,.<?eE+_~\\\0é", max_size=60) | st.lists(
    st.sampled_from(
        ["wheels:", " track:", "\n", "  ", "[", "]", "{", "}", "&a", "*a", "<<:", "!!int", "1e3", ".nan", "- "]
    ),
    max_size=20,
).map("".join)
NUMBERS = st.sampled_from(
    [math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-320, 0.0, -0.0, 1.0, -1.0, 1e6, 2**31, 2**63]
) | st.floats(width=64)


@QUICK
@given(YAML)
def test_any_text_is_read_or_refused(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(text, encoding="utf-8")
    said = "any.yaml"
    try:
        load_config(path)
    except FglocError as error:
        said = str(error)
    assert "any.yaml" in said


@QUICK
@given(st.recursive(NUMBERS | st.text(max_size=5) | st.none() | st.booleans(), st.lists, max_leaves=20))
def test_what_json_writes_is_read_back(value):
    def sound(part):
        return all(map(sound, part)) if isinstance(part, list) else not isinstance(part, float) or math.isfinite(part)

    if not sound(value):
        return
    text = json.dumps([value], ensure_ascii=True)
    if "1e" in text or "\\u" in text or "e-" in text or "e+" in text:
        return  # YAML 1.1 reads numbers with an exponent and no point as text, and has other escapes
    node = parse(text, "t")
    assert plain(node) == json.loads(text)


def _filled(kind, draw):
    """A message of a type with drawn numbers in every numeric field."""

    def value(field):
        node, content = field
        if node.name == "NAME":
            return message(content)
        if node.name == "BASE":
            return base(content[0])
        inner, length = content
        count = length if node.name == "ARRAY" else 2
        if inner[0].name == "BASE" and inner[1][0] not in ("string", "bool"):
            dtype = {"octet": "uint8", "char": "uint8", "byte": "uint8"}.get(inner[1][0], inner[1][0])
            with np.errstate(all="ignore"):
                return np.array([base(inner[1][0]) for _ in range(count)]).astype(dtype)
        return [value(inner) for _ in range(count)]

    def base(name):
        if name == "string":
            return draw(st.sampled_from(["", "a", "base_link", "tag36h11:7", "x\0", "99999999999999999999"]))
        if name == "bool":
            return draw(st.booleans())
        if name.startswith("float"):
            number = draw(NUMBERS)
            return (
                float(np.float32(number)) if name == "float32" and abs(number) < 3e38 else min(max(number, -3e38), 3e38)
            )
        bits = int("".join(c for c in name if c.isdigit()) or 8)
        low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if name.startswith("int") else (0, 2**bits - 1)
        return draw(st.sampled_from([low, high, 0, 1, high // 2]) | st.integers(low, high))

    def message(name):
        fields = STORE.fielddefs[name][1]
        return STORE.types[name](**{field: value(description) for field, description in fields})

    return message(kind)


@pytest.mark.parametrize(("role", "kind"), ROLES, ids=lambda part: str(part).rpartition("/")[2])
def test_absurd_numbers_in_every_field_are_judged(role, kind):
    @settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def judged(data):
        gate = EventValidator(GateConfig(), None)
        for k in range(3):
            message = _filled(kind, data.draw)
            with np.errstate(all="ignore"):
                try:
                    event = converters_of(role)[kind](message, (1_700_000_000_000_000_000 + k, k, "/t"))
                except (ValueError, OverflowError, TypeError):
                    return  # such a message is counted as one that cannot be decoded
            gate.check(event)

    judged()


def test_mutants_of_models_are_refused(tmp_path):
    source = sorted(Path(fgloc.__file__).parent.rglob("*.safetensors"))[0].read_bytes()
    refused = 0
    for seed in range(60):
        path = tmp_path / "m.safetensors"
        path.write_bytes(mutated(source[:3000], seed) + source[3000:])
        try:
            load_model(path)
        except ModelError:
            refused += 1
    assert refused > 20


def test_a_seed_gives_the_same_mutant():
    data = bytes(range(256)) * 4
    assert mutated(data, 5) == mutated(data, 5)
    assert len({mutated(data, seed) for seed in range(50)}) > 40
    assert len(MUTATIONS) == 9


def test_mutants_of_recordings_are_refused_or_salvaged(tmp_path):
    make_samples(tmp_path / "samples", seconds=1.0)
    zygote.load()
    cases = list(itertools.islice(recording_cases(tmp_path, itertools.count(), ("info",)), len(SAMPLES)))
    assert len(cases) == len(SAMPLES)
    assert {case.name: case.failures for case in cases if case.failures} == {}


def test_a_failure_is_seen():
    """What judges the cases tells a hang, a traceback and a signal from a refusal."""

    def raises():
        raise RuntimeError("oops")

    def hangs():
        while True:
            pass

    def dies():
        os.kill(os.getpid(), 9)

    def grows():
        return len(bytes(bytearray(1_200_000_000))) * 0

    assert zygote.forked(lambda: 1).failures() == []
    assert any("oops" in text for text in zygote.forked(raises).failures())
    assert zygote.forked(dies).failures() == ["exit code -9"]
    assert "MB" in zygote.forked(grows).failures()[0]
    began = time.monotonic()
    assert zygote.forked(hangs, seconds=1.0).failures() == ["hangs"]
    assert time.monotonic() - began < 10.0


@pytest.mark.parametrize("path", sorted(p for p in REGRESSIONS.iterdir() if p.suffix != ".md"), ids=lambda p: p.name)
def test_regressions(path):
    if path.suffix == ".yaml":
        with pytest.raises(FglocError):
            load_config(path)
    elif path.suffix == ".safetensors":
        with pytest.raises(ModelError):
            load_model(path)
    else:
        assert zygote.fgloc("info", path).failures() == []
