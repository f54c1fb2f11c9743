"""One mutant each: what is done with it, and what of that a user should never see."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import fgloc
from tests.fuzz import zygote
from tests.fuzz.hostile_yaml import SYNTAX, numeric_keys
from tests.fuzz.mutate import mutants, mutated
from tests.fuzz.samples import SAMPLES

MAX_SECONDS = 20.0
MAX_ATE_M = 0.05  # of a run that claims to be sound
_MODEL = Path(fgloc.__file__).parent
_VALUES = (".nan", ".inf", "1e300", "-1", "0", "1e-9", "999999", "[1, 2]", "''", "null", "true", "~", "9" * 100)


@dataclass(frozen=True)
class Case:
    """A mutant, where it is, and what went wrong with it."""

    name: str
    path: Path
    failures: tuple[str, ...]


def recording_cases(
    place: Path, seeds: Iterator[int], commands: tuple[str, ...] = ("info", "smooth")
) -> Iterator[Case]:
    """Mutants of the samples in ``place/samples`` through commands."""
    for name, path in mutants(place / "samples", place / "mutants", seeds):
        failures: list[str] = []
        for command in commands:
            out = place / "out"
            more = ("--out", out) if command != "info" else ()
            done = zygote.fgloc(command, path, *more, seconds=MAX_SECONDS)
            failures += [f"{command}: {text}" for text in done.failures()]
            if command != "info" and done.code == 0:
                failures += _wrong(out / "metrics.json", done.stdout)
        yield Case(name, path, tuple(failures))


def _wrong(metrics: Path, said: str) -> list[str]:
    """A run that ended well although its trajectory is wrong, and says nothing of it."""
    ate = json.loads(metrics.read_text())["ate_mean_m"]
    silent = not any(word in said for word in ("damaged", "lost", "mistake", "rejected   1", "undecodable"))
    return [f"silent error of {ate:.2f} m"] if silent and ate is not None and ate > MAX_ATE_M else []


def config_case(place: Path, seed: int) -> Case:
    """A configuration with a mutated text, or with a number that makes no sense."""
    rng = random.Random(seed)
    if rng.random() < 0.5:
        data = mutated(rng.choice(list(SYNTAX.values())).encode() or b"a: 1\n", seed)
    else:
        section, key, length = rng.choice(list(numeric_keys()))
        value = rng.choice(_VALUES)
        text = f"{key}: {f'[{value}]' if length else value}"
        for part in reversed(section.split(".")):
            text = f"{part}: {{{text}}}"
        data = text.encode()
    path = place / "fuzz.yaml"
    path.write_bytes(data)

    def read() -> int:
        from fgloc.config import load_config
        from fgloc.errors import FglocError

        try:
            load_config(path)
        except FglocError:
            return 1
        return 0

    return Case(f"config {seed}", path, tuple(zygote.forked(read, MAX_SECONDS).failures()))


def model_case(place: Path, seed: int) -> Case:
    """A shipped motion model with mutated bytes, most of them in its header."""
    rng = random.Random(seed)
    source = sorted(_MODEL.rglob("*.safetensors"))[0]
    data = source.read_bytes()
    head = rng.choice((200, 4000, len(data)))
    path = place / "fuzz.safetensors"
    path.write_bytes(mutated(data[:head], seed) + data[head:])

    def read() -> int:
        import numpy as np

        from fgloc.errors import FglocError
        from fgloc.sensors.learned.sensor import load_model

        try:
            model = load_model(path)
        except FglocError:
            return 1
        return 0 if np.isfinite(model.card.history_s) else 70

    return Case(f"model {seed}", path, tuple(zygote.forked(read, MAX_SECONDS).failures()))


__all__ = ["SAMPLES", "Case", "config_case", "model_case", "recording_cases"]
