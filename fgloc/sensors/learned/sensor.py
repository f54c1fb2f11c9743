"""The learned motion as a sensor: it has no topic of its own, but reads those of others."""

from __future__ import annotations

import copy
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from fgloc import se2
from fgloc.config import MotionConfig
from fgloc.errors import CovarianceError, ModelError
from fgloc.files.atomic import atomic_file
from fgloc.sensors.base import (
    BuiltIn,
    FoundRow,
    InstallationState,
    MotionInstallation,
    Parameter,
    Rank,
)
from fgloc.sensors.commands import told
from fgloc.sensors.learned.card import FORMAT, VERSION, ModelCard, SignalReader
from fgloc.sensors.learned.network import (
    Answering,
    DisplacementModel,
    MotionModel,
    NaiveModel,
    Network,
    RecurrentNetwork,
    VelocityModel,
)
from fgloc.types import ControlEvent, FloatArray, MotionEvent, MotionMeasurement, Setting, Step

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.drives.base import Drive


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
    return RecurrentNetwork([tensors[f"gru.{name}"] for name in _CELL], head, len(card.edges_s) - 1, mean, std)


def _widths(card: ModelCard) -> list[int]:
    """Widths of the network's layers, from input to output; empty for a model without a network."""
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


GAINS = ("scale", "turn_scale", "yaw_per_m")
"""Gains by which a robot differs from its model: settings, and parameters of the installation."""
_AS_ITS_MODEL = (1.0, 1.0, 0.0)
_GATE_SIGMA = 0.05  # share, rad/m: floor, load and battery change a robot by more than its prior, not by six of it


def gains_of(card: ModelCard) -> tuple[str, ...]:
    """Gains in which a robot may differ from this model: turns are the gyro's or the wheels', if it reads those."""
    return GAINS[:1] if card.reads("wheels") or card.reads("gyro") else GAINS


def _parameters(config: Config, sources: Collection[str]) -> tuple[Parameter, ...]:
    """Gains of the learned motion with their priors, those that ``sources`` names as ``learned.GAIN``."""
    motion = config.motion
    sigmas = {gain: motion.scale_sigma if gain == "scale" else motion.adaptation_sigma for gain in GAINS}
    adapts = motion.adaptation_sigma > 0.0 and "learned.turn_scale" in sources
    return tuple(
        Parameter(
            f"learned.{gain}",
            sigma if f"learned.{gain}" in sources else 0.0,
            Rank.MODEL,
            ("length",) if gain == "scale" else ("turn",),
            lengthens=gain == "scale",
            gate_sigma=_GATE_SIGMA if adapts else 0.0,
        )
        for gain, sigma in sigmas.items()
    )


def _found_rows(config: Config) -> tuple[FoundRow, ...]:
    """Rows of ``metrics.json`` on the learned motion."""
    turn = config.motion.turn_scale
    return (
        FoundRow("learned.scale", "learned.scale", 1.0, 1.0),
        FoundRow("learned.turn_scale", "learned.turn_scale", turn, turn),
        FoundRow("learned.yaw_per_m", "learned.yaw_per_m", config.motion.yaw_per_m, 1.0),
    )


def _settings(state: InstallationState, config: Config) -> Iterator[Setting]:
    """Gains of the learned motion, as a run has estimated them."""
    for gain in GAINS:
        given = getattr(config.motion, gain)
        factor = given if gain.endswith("scale") else 1.0
        now = given + factor * state.value(f"learned.{gain}")
        for s in state.setting(f"motion.{gain}", given, now, {f"learned.{gain}": factor}):
            yield s if gain == "scale" else replace(s, prior_sigma=max(s.prior_sigma, _GATE_SIGMA))


_SIGMAS = {"motion.scale": "motion.scale_sigma", "motion.turn_scale": "", "motion.yaw_per_m": ""}
INSTALLATION = MotionInstallation(_parameters, _found_rows, _settings, _SIGMAS)


class LearnedMotion:
    """Turns the commands of a step into a `MotionMeasurement` of source "learned".

    Between contiguous steps it carries the model's own velocity; a gap or a new segment forgets it, and the model
    starts from the commands before the step.

    Attributes:
        rejections: steps without a measurement, by reason: ``learned.no_commands``, ``learned.stale_commands``,
            ``learned.non_finite``, and ``learned.no_gyro``, ``learned.no_effort`` or ``learned.no_wheels`` where a
            signal that the model reads has a gap.
    """

    def __init__(
        self,
        model: MotionModel,
        config: MotionConfig,
        imu_up: ArrayLike = (0.0, 0.0, 1.0),
        drive: Drive | None = None,
    ) -> None:
        """Take a loaded model.

        Args:
            model: the model.
            config: whether it is used.
            imu_up: ``(3,)`` the base's z axis in the IMU's frame.
            drive: whose steering angle may be commanded in place of a yaw rate.
        """
        self.model = model
        self.rejections: Counter[str] = Counter()
        self._use = config.use
        self._reader = SignalReader(model.card, imu_up)
        self._gains = config.scale, config.turn_scale, config.yaw_per_m
        # A velocity model carries its velocity from step to step; measured signals are known for the step alone
        self._at_any_time = model.card.family != "velocity" and {*model.card.inputs} <= {"commands", "sideways"}
        self._drive, self._sideways = drive, "sideways" in model.card.inputs
        self._told: dict[ControlEvent, ControlEvent] = {}  # commands of the newest step as twists
        self._velocity: FloatArray | None = None
        self._reached: tuple[int, int] | None = None  # segment and stamp at which that velocity holds

    @property
    def signals_back_ns(self) -> int:
        """Time before a step [ns] for which the model reads measured signals; 0: it reads none."""
        return self._reader.back_ns

    def fork(
        self, model: MotionModel | None, events: Mapping[type[MotionEvent], Sequence[MotionEvent]]
    ) -> LearnedMotion:
        """A copy that may predict beyond the newest step without changing this one.

        Args:
            model: a copy of this one's, for use in another thread: a model writes into buffers of its own. None: to be
                forked again with one.
            events: of each class, those of the last `signals_back_ns` before the newest step's end.
        """
        forked = copy.copy(self)
        if model is None:
            del forked.model
        else:
            forked.model = model
        forked._reader, forked.rejections = self._reader.fork(events), Counter()
        return forked

    def measure(self, step: Step, gyro_bias: float = 0.0) -> MotionMeasurement | None:
        """Predict the step.

        Args:
            step: its commands must reach ``model.card.history_s`` back for a start from nothing.
            gyro_bias: to be taken out of the IMU's yaw rate [rad/s].

        Returns:
            None if the model is not used or cannot predict; the reason is counted in `rejections`.
        """
        if not self._use:
            return None
        commands = self._commands(step)
        if reason := self._unusable(commands, step.stamp_ns):
            self._reject(reason)
            return None
        signals = self._reader.read(step, gyro_bias)
        if isinstance(signals, str):
            self._reject(f"learned.no_{signals}")
            return None
        velocity = self._velocity if self._reached == (step.segment, step.start_ns) else None
        prediction = self.model.predict(commands, step.start_ns, step.stamp_ns, velocity, signals)
        if prediction is None:
            self._reject("learned.non_finite")
            return None
        self._velocity = prediction.velocity
        self._reached = (step.segment, step.stamp_ns)
        return MotionMeasurement("learned", step.start_ns, step.stamp_ns, prediction.motion, prediction.cov)

    def measure_adapted(
        self, step: Step, gyro_bias: float = 0.0
    ) -> tuple[MotionMeasurement, dict[str, FloatArray]] | None:
        """Predict the step for this robot, see `measure`: with its gains as they are configured.

        Returns:
            The motion, and its derivatives ``(3,)`` by the gains.
        """
        m = self.measure(step, gyro_bias)
        if m is None:
            return None
        scale, turn_scale, _ = self._gains
        ahead, left, turn = se2.log(m.motion).tolist()
        by = {
            "learned.scale": np.array([scale * ahead, scale * left, 0.0]),
            "learned.turn_scale": np.array([0.0, 0.0, turn_scale * turn]),
            "learned.yaw_per_m": np.array([0.0, 0.0, ahead]),
        }
        return replace(m, motion=self._adapted(m.motion)), by

    def _adapted(self, motion: FloatArray) -> FloatArray:
        """Motion ``(3,)`` of this robot where the model's is ``motion``."""
        if self._gains == _AS_ITS_MODEL:
            return motion
        scale, turn_scale, yaw_per_m = self._gains
        ahead, left, turn = se2.log(motion).tolist()
        return se2.exp(np.array([scale * ahead, scale * left, turn_scale * turn + yaw_per_m * ahead]))

    def motion_between(self, step: Step, start_ns: int, end_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """Motion ``(3,)`` and covariance ``(3, 3)`` from one time to another near the step's end, which may be earlier.

        Returns:
            None if the model reads more than commands, carries its velocity from step to step, is not used or cannot
            predict.
        """
        if not (self._use and self._at_any_time) or start_ns == end_ns:
            return None
        commands = self._commands(step)
        if self._unusable(commands, step.stamp_ns):
            return None
        found = self.model.predict(commands, min(start_ns, end_ns), max(start_ns, end_ns), None)
        if found is None:
            return None
        motion = self._adapted(found.motion)
        if start_ns < end_ns:
            return motion, found.cov
        ad = se2.adjoint(motion)
        return se2.inverse(motion), np.asarray(ad @ found.cov @ ad.T)

    def _commands(self, step: Step) -> tuple[ControlEvent, ...]:
        """Commands of a step as twists; of the same command the same object, by which a model goes on.

        One whose speed to the side is no number is passed over, if the model reads it.
        """
        commands = step.controls
        if self._sideways and not all(math.isfinite(command.vy) for command in commands):
            commands = tuple(command for command in commands if math.isfinite(command.vy))
        if self._drive is None or all(command.steering is None for command in commands):
            return commands
        self._told = {command: self._told.get(command) or told(command, self._drive) for command in commands}
        return tuple(self._told.values())

    def _unusable(self, commands: Sequence[ControlEvent], stamp_ns: int) -> str:
        for command in reversed(commands):
            if command.stamp_ns <= stamp_ns:
                stale = (stamp_ns - command.stamp_ns) * 1e-9 > self.model.card.hold_s
                return "learned.stale_commands" if stale else ""
        return "learned.no_commands"

    def _reject(self, reason: str) -> None:
        self.rejections[reason] += 1
        self._velocity = self._reached = None


def learned_motion(config: Config, up: Callable[[], FloatArray] | None) -> LearnedMotion | None:
    """The learned motion of one run; None: no model is used.

    Args:
        config: all settings.
        up: gives the base's z axis ``(3,)`` in the IMU's frame; None: the IMU is mounted level.

    Raises:
        ModelError: the model cannot be used.
    """
    if not config.motion.use or config.motion.model is None:
        return None
    level = (0.0, 0.0, 1.0) if up is None else up()
    return LearnedMotion(load_model(config.motion.model), config.motion, level, config.wheels.drive)


def with_model(config: Config, model: Path) -> Config:
    """Settings with another model.

    Raises:
        pydantic.ValidationError: no model of this name is shipped.
    """
    motion = MotionConfig(model=model, use=True, correlation=config.motion.correlation)
    return config.model_copy(update={"motion": motion})


def left_out_note(seconds: float) -> str:
    """Sentence for the user where sightings contradicted the model for so long [s]."""
    return (
        f"The motion model was left out for {seconds:.1f} s: sightings contradict it. It may be of another robot or "
        "floor: train one of this robot (fgloc train), or set expert.motion.use: false."
    )


LEARNED = BuiltIn(name="learned", title="learned motion", installation=INSTALLATION)
