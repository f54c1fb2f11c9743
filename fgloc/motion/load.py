"""Model files: weights in safetensors, the card as JSON in its header. Nothing is ever unpickled."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from fgloc.errors import CovarianceError, ModelError
from fgloc.motion.card import FORMAT, VERSION, ModelCard
from fgloc.motion.displacement import DisplacementModel
from fgloc.motion.forms import MotionModel
from fgloc.motion.network import Network
from fgloc.motion.velocity import VelocityModel

_MAX_BYTES = 64 << 20
_REMEDY = "export it again with python -m training.train"
Tensors = dict[str, NDArray[np.float32]]


def load_model(path: Path) -> MotionModel:
    """Read a model and check that its parts fit each other.

    Raises:
        ModelError: the file is missing, is not safetensors (a pickle, say), is damaged, is of another kind or version,
            or its card, shapes or numbers do not fit; both sides are named.
    """
    tensors, card = read_model(path)
    layers = _layers(tensors, card, path)
    scale = offset = None
    if card.kind == "displacement":
        scale = np.array([*card.output_scale, 1.0, 1.0, 1.0])
        offset = np.array([0.0, 0.0, 0.0, *np.log(card.variance_scale)])
    network = Network(layers, np.array(card.input_mean), np.array(card.input_std), scale, offset)
    try:
        return VelocityModel(card, network) if card.kind == "velocity" else DisplacementModel(card, network)
    except CovarianceError as error:
        raise ModelError(f"{path}: its joint calibration cannot be used: {error}; {_REMEDY}") from error


def read_model(path: Path) -> tuple[Tensors, ModelCard]:
    """Raw weights by name and the checked card; errors as in `load_model`."""
    try:
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
    temporary = path.with_name(path.name + ".part")
    temporary.write_bytes(save(tensors, metadata=metadata))
    try:
        load_model(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _card(metadata: dict[str, str], path: Path) -> ModelCard:
    try:
        fields = json.loads(metadata["card"])
    except KeyError:
        raise ModelError(f"{path}: has no card (inputs, normalization, noise) in its header; {_REMEDY}") from None
    except ValueError as error:
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


def _layers(tensors: Tensors, card: ModelCard, path: Path) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    widths = [card.n_inputs, *card.hidden, card.n_outputs]
    expected: dict[str, tuple[int, ...]] = {}
    stack = (card.members,) if card.members > 1 else ()
    for i, (n_in, n_out) in enumerate(pairwise(widths)):
        expected[f"layer{i}.weight"] = (*stack, n_out, n_in)
        expected[f"layer{i}.bias"] = (*stack, n_out)
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
    return [(tensors[f"layer{i}.weight"], tensors[f"layer{i}.bias"]) for i in range(len(widths) - 1)]
