"""The adaptive mechanisms of fgloc, and how `benchmarks.mechanisms` takes each of them away.

A mechanism adapts a weight, a covariance, an association or a state by evidence. Not in the table: the graph itself
with its installation parameters and the marginal covariances, noise that is calibrated and follows no evidence (blur of
corners, correlation of the errors of one landmark, or of wheels and learned motion), checks of single messages
(``intake``, encoder resets), the handling of errors inside GTSAM, and what only an unknown map needs. What only works
together is one row, and so is one filter.

A switch replaces one function or constant of fgloc by `unittest.mock.patch` for as long as a context holds; fgloc has
no settings for this. A probe wraps one function and counts the calls whose result differs from what the mechanism would
give if it were off. Where a probe counts nothing in a run, the run with the mechanism off is the same run.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import dataclass, replace
from functools import wraps
from pkgutil import resolve_name
from typing import Any
from unittest.mock import patch

import numpy as np

from fgloc.graph.noise import NoiseBudget

Function = Callable[..., Any]
JOIN = "+"  # between the names of mechanisms that are switched off at once


@dataclass(frozen=True, slots=True)
class Returns:
    """Replaces a function by one that returns a copy of a value, which the caller may change."""

    value: Any

    def __call__(self, real: Any) -> Function:
        """The replacement."""
        return lambda *args, **kwargs: copy(self.value)


@dataclass(frozen=True, slots=True)
class Constant:
    """Replaces a module's constant."""

    value: Any

    def __call__(self, real: Any) -> Any:
        """The replacement."""
        return self.value


@dataclass(frozen=True, slots=True)
class Argument:
    """Replaces a function by one that returns one of its positional arguments."""

    index: int

    def __call__(self, real: Any) -> Function:
        """The replacement."""
        return lambda *args, **kwargs: args[self.index]


@dataclass(frozen=True, slots=True)
class Switch:
    """One replacement.

    Attributes:
        target: ``package.module:name`` or ``package.module:Class.name``.
        off: makes the replacement of what is there.
    """

    target: str
    off: Callable[[Any], Any]

    def place(self) -> tuple[Any, str]:
        """The object that holds what is replaced, and its name there.

        Raises:
            AttributeError: fgloc has no such name; where the mechanism was deleted, delete its row as well.
        """
        owner, _, name = self.target.rpartition("." if "." in self.target.partition(":")[2] else ":")
        holder = resolve_name(owner)
        if not hasattr(holder, name):
            raise AttributeError(f"{self.target} does not exist; is the mechanism gone? Then delete its row")
        return holder, name

    @contextmanager
    def replaced(self) -> Iterator[None]:
        """The replacement stands while this holds."""
        holder, name = self.place()
        with patch.object(holder, name, self.off(getattr(holder, name))):
            yield


def _nothing(*args: Any) -> None:
    return None


@dataclass(frozen=True, slots=True)
class Probe:
    """A function to be watched.

    Attributes:
        target: as that of a switch.
        acts: given the result, what `before` gave, and the positional arguments: whether the mechanism acted.
        before: given the positional arguments before the call.
    """

    target: str
    acts: Callable[..., Any]
    before: Callable[..., Any] = _nothing


@dataclass(frozen=True, slots=True)
class Mechanism:
    """Mechanism that adapts a weight, a covariance, an association or a state by evidence.

    Attributes:
        name: in the ids of rows.
        purpose: what it is for.
        switches: all of them together take it away.
        probe: observes where it acts; None: it acts always, or no single function shows it.
        batch: whether the smoothed result can depend on it.
        case: a failure that it is for; it is run first.
    """

    name: str
    purpose: str
    switches: tuple[Switch, ...]
    probe: Probe | None = None
    batch: bool = False
    case: str = "none"

    @contextmanager
    def off(self) -> Iterator[None]:
        """Switch the mechanism off inside a ``with``."""
        with ExitStack() as stack:
            for switch in self.switches:
                stack.enter_context(switch.replaced())
            yield


def together(mechanisms: Sequence[Mechanism]) -> Mechanism:
    """Join mechanisms into one."""
    switches = tuple(switch for m in mechanisms for switch in m.switches)
    return Mechanism(JOIN.join(m.name for m in mechanisms), "Several at once.", switches, batch=True)


@contextmanager
def watched(mechanisms: Iterable[Mechanism]) -> Iterator[Counter[str]]:
    """Counts, by the name of the mechanism, how often each one with a probe acts while this holds."""
    counts: Counter[str] = Counter()
    with ExitStack() as stack:
        for mechanism in mechanisms:
            if mechanism.probe is not None:
                counting = Switch(mechanism.probe.target, _Counting(mechanism.name, mechanism.probe, counts))
                stack.enter_context(counting.replaced())
        yield counts


@dataclass(frozen=True, slots=True)
class _Counting:
    name: str
    probe: Probe
    counts: Counter[str]

    def __call__(self, real: Function) -> Function:
        @wraps(real)
        def counted(*args: Any, **kwargs: Any) -> Any:
            before = self.probe.before(*args)
            result = real(*args, **kwargs)
            self.counts[self.name] += bool(self.probe.acts(result, before, *args))
            return result

        return counted


# --- Probes -----------------------------------------------------------------------------------------------------------


def something(result: Any, *args: Any) -> bool:
    """Whether the result is not empty, zero or false, so that the mechanism acted."""
    return bool(result)


def not_none(result: Any, *args: Any) -> bool:
    """Whether there is a result, so that the mechanism acted."""
    return result is not None


def called(*args: Any) -> bool:
    """Whether the function was called, so that the mechanism acted: always."""
    return True


# --- The mechanisms ---------------------------------------------------------------------------------------------------

_GATE = "fgloc.estimation.sightings"
_POSE_FIT = "fgloc.estimation.pose_fit"
_NO_KERNEL = 1e6  # sigmas
_MODES = "fgloc.estimation.landmark_modes:LandmarkModes"
_MOTION = "fgloc.estimation.motion"
_FAULTS = "fgloc.estimation.faults"
_BUDGET = "fgloc.graph.noise"
_WHERE = "fgloc.estimation.tracking:Tracking"


def _unscaled(real: Function) -> Function:
    return lambda budget, readings, rules: real(replace(budget, scale=1.0), readings, rules)


def _scaled(result: Any, before: Any, budget: NoiseBudget, *args: Any) -> bool:
    return budget.scale > 1.0


def _without_wheels(result: Any, before: Any, budget: NoiseBudget, *args: Any) -> bool:
    return "wheels" in budget.rejected


def _as_given(real: Any) -> property:
    return property(lambda test: 1.0)


def _model_contradicted(found: Any, *_: Any) -> bool:
    return found is not None and "learned" in found.sources


def _never(real: Any) -> property:
    return property(lambda self: False)


OF_SIGHTINGS: tuple[Mechanism, ...] = (
    Mechanism(
        "fit_kernel",
        "Cauchy kernel in the fit of a pose to sightings: one wrong sighting does not corrupt the pose.",
        (Switch(f"{_POSE_FIT}:_kernel", Returns(_NO_KERNEL)),),
        batch=True,
        case="carried30",
    ),
    Mechanism(
        "gate",
        "Chi-square gate online, with the test of joint compatibility: unlikely sightings are not fused.",
        (Switch(f"{_GATE}:chi2_bound", Returns(math.inf)),),
        batch=True,
        case="kidnap",
    ),
    Mechanism(
        "joint_compatibility",
        "Of sightings that exclude each other, an uncertain prediction keeps the largest set that agrees.",
        (Switch(f"{_GATE}:Association._agreed", Argument(3)),),
        Probe(f"{_GATE}:Association._agreed", lambda result, _, *args: result != args[3]),
        batch=True,
        case="ids30",
    ),
    Mechanism(
        "misread_ids",
        "A refused marker where exactly one other marker of the map would be seen is taken for that other one.",
        (Switch(f"{_GATE}:Association._reassociate", Returns(())),),
        Probe(f"{_GATE}:Association._reassociate", something),
        batch=True,
        case="ids30",
    ),
    Mechanism(
        "overruled_prediction",
        "Refused sightings of two landmarks that agree on a place nearby widen the motion and are fused.",
        (Switch(f"{_GATE}:Association.nearby_consensus", Returns(None)),),
        Probe(f"{_GATE}:Association.nearby_consensus", not_none),
        batch=True,
        case="pushed",
    ),
    Mechanism(
        "landmark_modes",
        "A landmark whose displacement explains what is seen much better is named as moved and left out.",
        (Switch(f"{_MODES}.observe", Returns(None)),),
        Probe(f"{_MODES}.observe", not_none),
        batch=True,
        case="moved",
    ),
)

OF_MOTION: tuple[Mechanism, ...] = (
    Mechanism(
        "disagreement_test",
        "GLR test of wheels against learned motion or gyro: slipping or dead wheels are left out.",
        (Switch(f"{_FAULTS}:GlrTest._nis_of_windows", Returns(np.zeros(1))),),
        Probe(f"{_FAULTS}:GlrTest.judge", lambda verdict, *_: verdict.flagged),
        batch=True,
        case="onewheel",
    ),
    Mechanism(
        "fault_attribution",
        "Where wheels and learned motion differ, the one that sightings contradict is left out.",
        (Switch(f"{_FAULTS}:FaultAttribution.contradicted", Returns(None)),),
        Probe(f"{_FAULTS}:FaultAttribution.contradicted", _model_contradicted),
        batch=True,
        case="foreign",
    ),
    Mechanism(
        "disagreement_scale",
        "Covariances of motion sources that disagree are scaled before the alarm.",
        (Switch(f"{_BUDGET}:NoiseBudget.combine", _unscaled),),
        Probe(f"{_BUDGET}:NoiseBudget.combine", _scaled),
        batch=True,
        case="dark60",
    ),
    Mechanism(
        "disagreement_level",
        "Differences of the motion sources are compared with what is usual, not with their covariances alone.",
        (Switch(f"{_FAULTS}:GlrTest._level", _as_given),),
        Probe(f"{_FAULTS}:GlrTest.judge", lambda _, before, test, *args: test._level < 1.0),
        batch=True,
        case="dark60",
    ),
    Mechanism(
        "learned_alone",
        "Beside wheels that are left out the learned motion's covariance is four times its own.",
        (Switch(f"{_BUDGET}:COVARIANCE_FACTOR", Constant(1.0)),),
        Probe(f"{_BUDGET}:NoiseBudget.combine", _without_wheels),
        batch=True,
        case="dark60",
    ),
    Mechanism(
        "onset_reweighing",
        "Steps between the likeliest onset of a fault and its detection are weighed again.",
        (Switch(f"{_MOTION}:MotionJudge._revise", Returns(())),),
        Probe(f"{_MOTION}:MotionJudge._revise", lambda result, _, self, verdict: verdict.span > 1),
        batch=True,
        case="foreign",
    ),
    Mechanism(
        "failure_kind",
        "Distinguishes frozen encoders and one dead wheel from slip.",
        (Switch(f"{_MOTION}:MotionFaultMonitor._failure", Returns("slip")),),
        Probe(f"{_MOTION}:MotionFaultMonitor._failure", lambda kind, *_: kind != "slip"),
        case="onewheel",
    ),
    Mechanism(
        "doubtful_wheels",
        "Flagged wheels that nothing replaces stay, with a covariance that allows for the fault.",
        (Switch(f"{_BUDGET}:NoiseBudget._with_slip", Argument(1)),),
        Probe(f"{_BUDGET}:NoiseBudget._with_slip", called),
        batch=True,
        case="foreign",
    ),
    Mechanism(
        "gyro_bias",
        "The gyro's bias is learned while the wheels stand, and between two fixes of the yaw.",
        (Switch("fgloc.sensors.gyro:Gyro._learn", Returns(None)),),
        Probe("fgloc.sensors.gyro:Gyro._learn", called),
        batch=True,
        case="dark60",
    ),
)

OF_TRACKING: tuple[Mechanism, ...] = (
    Mechanism(
        "place_search",
        "While every sighting is refused, another place that explains them is searched for on the map.",
        (Switch(f"{_WHERE}.search", Returns(None)),),
        Probe(f"{_WHERE}.search", not_none),
        batch=True,
        case="kidnap",
    ),
    Mechanism(
        "lost_by_covariance",
        "A pose too uncertain for any sighting to be judged by makes the robot lost.",
        (Switch(f"{_WHERE}.is_unlocalized", Returns(False)),),
        Probe(f"{_WHERE}.is_unlocalized", something),
        batch=True,
        case="robot_moved",
    ),
    Mechanism(
        "lift",
        "A robot that rises, or turns though it stands, is carried: no source knows its motion.",
        (Switch(f"{_FAULTS}:LiftMonitor.observe", Returns([])),),
        Probe(f"{_FAULTS}:LiftMonitor.observe", something),
        batch=True,
        case="lifted",
    ),
    Mechanism(
        "given_pose_held",
        "A given first pose holds against sightings that contradict it from the start.",
        (Switch(f"{_WHERE}.keeps_initial_pose", _never),),
        Probe(f"{_WHERE}.gate_initial_pose", lambda _, before, where, *args: where.keeps_initial_pose),
        batch=True,
        case="given",
    ),
    Mechanism(
        "start_trimming",
        "A place is fitted again to the sightings that it explains.",
        (Switch("fgloc.estimation.place:MOST_STEPS", Constant(0)),),
        case="ids30",
    ),
)

MECHANISMS: tuple[Mechanism, ...] = (*OF_SIGHTINGS, *OF_MOTION, *OF_TRACKING)
BY_NAME = {m.name: m for m in MECHANISMS}
