"""Model files: what does not fit is refused at load, and nothing is ever unpickled."""

from __future__ import annotations

import json
import os
import pickle
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_models import make_card, make_tensors
from refusal import refusal
from safetensors import SafetensorError
from safetensors.numpy import save_file

from fgloc.errors import ModelError
from fgloc.sensors.learned.card import ModelCard
from fgloc.sensors.learned.sensor import load_model, save_model


@pytest.fixture
def card() -> ModelCard:
    return make_card("displacement")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def write(path: Path, tensors: dict[str, np.ndarray], card: ModelCard, **changes: Any) -> Path:
    """A file as a careless program would write it: nothing is checked. None removes a field."""
    fields = json.loads(card.model_dump_json())
    fields = {k: v for k, v in (fields | changes).items() if v is not None}
    save_file(tensors, path, metadata={"card": json.dumps(fields)})
    return path


def test_fault_34_wrong_input_size(card: ModelCard, rng: np.random.Generator, tmp_path: Path) -> None:
    tensors = make_tensors(card, rng)
    tensors["layer0.weight"] = tensors["layer0.weight"][:, :5].copy()
    with refusal(ModelError, "layer0.weight", (16, 5), (16, 16)):
        load_model(write(tmp_path / "m.safetensors", tensors, card))


def test_fault_34_wrong_normalization(card: ModelCard, rng: np.random.Generator, tmp_path: Path) -> None:
    tensors = make_tensors(card, rng)
    path = tmp_path / "m.safetensors"
    with pytest.raises(ModelError, match=r"input_mean .*\b5\b.*\b16\b"):
        load_model(write(path, tensors, card, input_mean=[0.0] * 5))
    with pytest.raises(ModelError, match=r"\binput_std\b"):
        load_model(write(path, tensors, card, input_std=None))
    with pytest.raises(ModelError, match=r"\binput_std\b.*\b0\b"):
        load_model(write(path, tensors, card, input_std=[0.0] * 16))
    with pytest.raises(ModelError, match=r"output_scale .*\b2\b.*\b3\b"):
        load_model(write(path, tensors, card, output_scale=[1.0, 1.0]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "telepathy"}, r"kind.*'naive'.*'gru'.*'telepathy'"),
        ({"version": 2}, r"'fgloc-motion', 2\).*'fgloc-motion', 1\)"),
        ({"format": "other"}, r"'other'.*'fgloc-motion'"),
        ({"inputs": ["commands", "lidar"]}, "lidar"),
        ({"kind": "velocity"}, r"\['commands', 'velocity'\].*\['velocity'\]"),
        ({"hidden": [16, 8]}, r"layer1\.weight .*\(16, 16\).*\(8, 16\)"),
        ({"hidden": [16]}, r"\['layer0\.bias', .*'layer2\..*\].*\['layer0\.bias', .*'layer1\."),
        ({"edges_s": [0.0, 0.2, 0.1]}, "increasing"),
        ({"surprise": 1}, "surprise"),
        ({"dt_s": float("nan")}, "dt_s"),
        ({"joint": {"window_s": 5.0, "W": [[1, 0, 0]] * 3, "N": [[1, 0, 0]] * 3, "C": [[0, 0, 0]] * 3}}, "joint"),
    ],
)
def test_fault_34_card_does_not_fit(
    changes: dict[str, Any], message: str, card: ModelCard, rng: np.random.Generator, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=message):
        load_model(write(tmp_path / "m.safetensors", make_tensors(card, rng), card, **changes))


def test_weights_must_be_finite_and_float32(card: ModelCard, rng: np.random.Generator, tmp_path: Path) -> None:
    tensors = make_tensors(card, rng)
    path = tmp_path / "m.safetensors"
    with pytest.raises(ModelError, match=r"layer1\.bias .*float64.*float32"):
        load_model(write(path, tensors | {"layer1.bias": np.zeros(16)}, card))
    tensors["layer1.bias"][3] = np.nan
    with pytest.raises(ModelError, match=r"layer1\.bias .*NaN"):
        load_model(write(path, tensors, card))
    with pytest.raises(ModelError, match=r"layer1\.bias .*NaN"):
        save_model(tmp_path / "n.safetensors", tensors, card)
    assert not list(tmp_path.glob("n.*"))


def test_no_card_or_no_file(card: ModelCard, rng: np.random.Generator, tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    for nothing in (path, tmp_path):
        with refusal(ModelError, nothing):
            load_model(nothing)
    save_file(make_tensors(card, rng), path)
    with refusal(ModelError, path, "card"):
        load_model(path)
    save_file(make_tensors(card, rng), path, metadata={"card": "{"})
    with refusal(ModelError, path, "card", cause=json.JSONDecodeError):
        load_model(path)
    save_file(make_tensors(card, rng), path, metadata={"card": "[1]"})
    with refusal(ModelError, path, "[1]", "'fgloc-motion', 1)"):
        load_model(path)


class _Malicious:
    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.victim),)


def test_fault_35_pickle_is_refused_unread(tmp_path: Path) -> None:
    victim = tmp_path / "made_by_the_pickle"
    path = tmp_path / "model.safetensors"
    path.write_bytes(pickle.dumps(_Malicious(victim)))
    with refusal(ModelError, path, cause=SafetensorError):
        load_model(path)
    assert not victim.exists()
    pickle.loads(path.read_bytes())  # it would have
    assert victim.exists()


def test_fault_35_damaged_file(card: ModelCard, rng: np.random.Generator, tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    save_model(path, make_tensors(card, rng), card)
    sound = path.read_bytes()
    for data in (b"", b"\0" * 8, sound[:4], sound[: len(sound) // 2], sound[:-1], sound + b"x", b"\xff" * len(sound)):
        path.write_bytes(data)
        with pytest.raises(ModelError, match=str(path)):
            load_model(path)
    header = int.from_bytes(sound[:8], "little")
    for _ in range(300):  # a flipped bit in the header is refused, or still leaves a model that fits
        damaged = bytearray(sound)
        damaged[rng.integers(8 + header)] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with suppress(ModelError):
            load_model(path)


def test_fault_35_enormous_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    with path.open("wb") as file:
        file.truncate(1 << 30)  # sparse
    with pytest.raises(ModelError, match="at most"):
        load_model(path)
