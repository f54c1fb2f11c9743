"""Model files: weights in safetensors, the card as JSON in its header. Nothing is ever unpickled."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from fgloc.errors import CovarianceError, ModelError
from fgloc.files.atomic import atomic_file
from fgloc.sensors.learned.card import FORMAT, VERSION, ModelCard
from fgloc.sensors.learned.displacement import DisplacementModel
from fgloc.sensors.learned.forms import MotionModel
from fgloc.sensors.learned.network import Answering, Network
from fgloc.sensors.learned.recurrent import Cell, RecurrentNetwork
from fgloc.sensors.learned.velocity import NaiveModel, VelocityModel

_CELL = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
_MAX_BYTES = 64 << 20
_REMEDY = "export it again with fgloc train"
Tensors = dict[str, NDArray[np.float32]]


def load_model(path: Path) -> MotionModel:
    """Read a model and check that its parts fit each other.

    Raises:
        ModelError: the file is missing, is not safetensors (a pickle, say), is damaged, is of another kind or version,
            or its card, shapes or numbers do not fit; both sides are named.
    """
    return model_of(*read_model(path), path)


def model_of(tensors: Tensors, card: ModelCard, path: Path = Path("model")) -> MotionModel:
    """The model of weights and card; errors as in `load_model`, which name ``path``."""
    _check(tensors, card, path)
    try:
        if card.family == "naive":
            return NaiveModel(card)
        if card.family == "displacement":
            return DisplacementModel(card, _network(tensors, card))
        return VelocityModel(card, None if card.kind == "lag" else _network(tensors, card))
    except CovarianceError as error:
        raise ModelError(f"{path}: its joint calibration cannot be used: {error}; {_REMEDY}") from error


def read_model(path: Path) -> tuple[Tensors, ModelCard]:
    """Raw weights by name and the checked card; errors as in `load_model`."""
    try:
        if path.exists() and not path.is_file():
            raise ModelError(f"{path}: not a regular file; give a .safetensors file")
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise ModelError(f"{path}: {size} bytes, expected a motion model of at most {_MAX_BYTES}")
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror or error}); give a .safetensors file") from error
    except (SafetensorError, TypeError, ValueError) as error:
        raise ModelError(
            f"{path}: not a sound safetensors file ({error}); other formats, pickles above all, are refused; {_REMEDY}"
        ) from error
    return tensors, _card(metadata, path)


def save_model(path: Path, tensors: Tensors, card: ModelCard) -> None:
    """Write a model file that `load_model` accepts, atomically."""
    metadata = {"card": card.model_dump_json()}  # one entry: the order of several would differ from run to run
    data = save(tensors, metadata=metadata)
    with TemporaryDirectory(prefix="fgloc-") as folder:
        (Path(folder) / path.name).write_bytes(data)
        load_model(Path(folder) / path.name)
    with atomic_file(path, binary=True) as file:
        file.write(data)


def _card(metadata: dict[str, str], path: Path) -> ModelCard:
    try:
        fields = json.loads(metadata["card"])
    except KeyError:
        raise ModelError(f"{path}: has no card (inputs, normalization, noise) in its header; {_REMEDY}") from None
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{path}: its card is not JSON ({error}); {_REMEDY}") from error
    found = (fields.get("format"), fields.get("version")) if isinstance(fields, dict) else fields
    if found != (FORMAT, VERSION):
        raise ModelError(
            f"{path}: format and version are {found!r}, this program reads {(FORMAT, VERSION)!r}; {_REMEDY}"
        )
    try:
        return ModelCard.model_validate(fields)
    except ValidationError as error:
        lines = "; ".join(
            f"{'.'.join(str(p) for p in e['loc']) or 'card'}: {e['msg']}"
            + ("" if isinstance(e["input"], dict) else f" (got {e['input']!r})")
            for e in error.errors()
        )
        raise ModelError(f"{path}: its card does not fit: {lines}; {_REMEDY}") from error


def _network(tensors: Tensors, card: ModelCard) -> Answering:
    """The network with its normalization; the outputs of a displacement model come out scaled."""
    layers = [(tensors[f"layer{i}.weight"], tensors[f"layer{i}.bias"]) for i in range(len(_widths(card)) - 1)]
    mean, std = np.array(card.input_mean), np.array(card.input_std)
    if card.family == "velocity":
        return Network(layers, mean, std)
    scale = np.array([*card.output_scale, 1.0, 1.0, 1.0])
    offset = np.array([0.0, 0.0, 0.0, *np.log(card.variance_scale)])
    if card.kind == "displacement":
        return Network(layers, mean, std, scale, offset)
    width = _widths(card)[0]
    head = Network(layers, np.zeros(width), np.ones(width), scale, offset)
    cell = Cell(*(tensors[f"gru.{name}"] for name in _CELL))
    return RecurrentNetwork(cell, head, len(card.edges_s) - 1, mean, std)


def _widths(card: ModelCard) -> list[int]:
    """Of the layers, from input to output."""
    if card.kind in ("naive", "lag"):
        return []
    if card.kind == "gru":
        return [card.hidden[0] + card.n_inputs - 2 * (len(card.edges_s) - 1), *card.hidden[1:], card.n_outputs]
    return [card.n_inputs, *card.hidden, card.n_outputs]


def _check(tensors: Tensors, card: ModelCard, path: Path) -> None:
    """Refuse weights that are not those of the card's network."""
    expected: dict[str, tuple[int, ...]] = {}
    stack = (card.members,) if card.members > 1 else ()
    for i, (n_in, n_out) in enumerate(pairwise(_widths(card))):
        expected[f"layer{i}.weight"] = (*stack, n_out, n_in)
        expected[f"layer{i}.bias"] = (*stack, n_out)
    if card.kind == "gru":
        h = card.hidden[0]
        expected |= {
            f"gru.{name}": shape
            for name, shape in zip(_CELL, ((3 * h, 2), (3 * h, h), (3 * h,), (3 * h,)), strict=True)
        }
    if set(tensors) != set(expected):
        raise ModelError(f"{path}: holds the tensors {sorted(tensors)}, its card needs {sorted(expected)}; {_REMEDY}")
    for name, shape in expected.items():
        tensor = tensors[name]
        if tensor.shape != shape:
            raise ModelError(
                f"{path}: {name} has shape {tensor.shape}, its card ({card.kind}, inputs {', '.join(card.inputs)}) "
                f"needs {shape}; {_REMEDY}"
            )
        if tensor.dtype != np.float32:
            raise ModelError(f"{path}: {name} is {tensor.dtype}, expected float32; {_REMEDY}")
        if not np.isfinite(tensor).all():
            raise ModelError(f"{path}: {name} holds NaN or infinite weights, expected finite ones; {_REMEDY}")
