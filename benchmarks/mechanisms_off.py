"""The adaptive mechanisms of fgloc, and how `benchmarks.mechanisms` takes each of them away.

A mechanism adapts a weight, a covariance, an association or a state by evidence. Not in the table: the graph itself
with its installation parameters and the marginal covariances, noise that is calibrated and follows no evidence (blur of
corners, correlation of the errors of one landmark, or of wheels and learned motion), checks of single messages
(``intake``, encoder resets), the handling of errors inside GTSAM, and what only an unknown map needs. What only works
together is one row, and so is one filter.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.mechanisms_switch import (
    Argument,
    Constant,
    Function,
    Mechanism,
    Probe,
    Returns,
    Switch,
    called,
    not_none,
    something,
)
from fgloc.graph.noise import NoiseBudget

_GATE = "fgloc.estimation.sightings"
_POSE_FIT = "fgloc.estimation.pose_fit"
_NO_KERNEL = 1e6  # sigmas
_MODES = "fgloc.estimation.landmark_modes:LandmarkModes"
_MOTION = "fgloc.estimation.motion"
_FAULTS = "fgloc.estimation.faults"
_BUDGET = "fgloc.graph.noise"
_CONSENSUS = "fgloc.estimation.pose_fit:PoseConsensus"
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
        ("estimation/pose_fit.py",),
        (Switch(f"{_POSE_FIT}:_kernel", Returns(_NO_KERNEL)),),
        batch=True,
        case="carried30",
    ),
    Mechanism(
        "gate",
        "Chi-square gate online, with the test of joint compatibility: unlikely sightings are not fused.",
        ("estimation/sightings.py",),
        (Switch(f"{_GATE}:chi2_bound", Returns(math.inf)),),
        batch=True,
        case="kidnap",
    ),
    Mechanism(
        "joint_compatibility",
        "Of sightings that exclude each other, an uncertain prediction keeps the largest set that agrees.",
        ("estimation/sightings.py",),
        (Switch(f"{_GATE}:Association._agreed", Argument(3)),),
        Probe(f"{_GATE}:Association._agreed", lambda result, _, *args: result != args[3]),
        batch=True,
        case="ids30",
    ),
    Mechanism(
        "misread_ids",
        "A refused marker where exactly one other marker of the map would be seen is taken for that other one.",
        ("estimation/sightings.py", "graph/factors.py"),
        (Switch(f"{_GATE}:Association._reassociate", Returns(())),),
        Probe(f"{_GATE}:Association._reassociate", something),
        batch=True,
        case="ids30",
    ),
    Mechanism(
        "overruled_prediction",
        "Refused sightings of two landmarks that agree on a place nearby widen the motion and are fused.",
        ("estimation/sightings.py",),
        (Switch(f"{_GATE}:Association.nearby_consensus", Returns(None)),),
        Probe(f"{_GATE}:Association.nearby_consensus", not_none),
        batch=True,
        case="pushed",
    ),
    Mechanism(
        "landmark_modes",
        "A landmark whose displacement explains what is seen much better is named as moved and left out.",
        ("estimation/landmark_modes.py",),
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
        ("estimation/faults.py", "estimation/motion.py"),
        (Switch(f"{_FAULTS}:GlrTest._nis_of_windows", Returns(np.zeros(1))),),
        Probe(f"{_FAULTS}:GlrTest.judge", lambda verdict, *_: verdict.flagged),
        batch=True,
        case="onewheel",
    ),
    Mechanism(
        "fault_attribution",
        "Where wheels and learned motion differ, the one that sightings contradict is left out.",
        ("estimation/faults.py", "estimation/motion.py"),
        (Switch(f"{_FAULTS}:FaultAttribution.contradicted", Returns(None)),),
        Probe(f"{_FAULTS}:FaultAttribution.contradicted", _model_contradicted),
        batch=True,
        case="foreign",
    ),
    Mechanism(
        "disagreement_scale",
        "Covariances of motion sources that disagree are scaled before the alarm.",
        ("estimation/faults.py", "graph/noise.py"),
        (Switch(f"{_BUDGET}:NoiseBudget.combine", _unscaled),),
        Probe(f"{_BUDGET}:NoiseBudget.combine", _scaled),
        batch=True,
        case="dark60",
    ),
    Mechanism(
        "disagreement_level",
        "Differences of the motion sources are compared with what is usual, not with their covariances alone.",
        ("estimation/faults.py",),
        (Switch(f"{_FAULTS}:GlrTest._level", _as_given),),
        Probe(f"{_FAULTS}:GlrTest.judge", lambda _, before, test, *args: test._level < 1.0),
        batch=True,
        case="dark60",
    ),
    Mechanism(
        "learned_alone",
        "Beside wheels that are left out the learned motion's covariance is four times its own.",
        ("graph/noise.py",),
        (Switch(f"{_BUDGET}:COVARIANCE_FACTOR", Constant(1.0)),),
        Probe(f"{_BUDGET}:NoiseBudget.combine", _without_wheels),
        batch=True,
        case="dark60",
    ),
    Mechanism(
        "onset_reweighing",
        "Steps between the likeliest onset of a fault and its detection are weighed again.",
        ("estimation/motion.py", "graph/estimators.py"),
        (Switch(f"{_MOTION}:MotionJudge._revise", Returns(())),),
        Probe(f"{_MOTION}:MotionJudge._revise", lambda result, _, self, verdict: verdict.span > 1),
        batch=True,
        case="foreign",
    ),
    Mechanism(
        "failure_kind",
        "Distinguishes frozen encoders and one dead wheel from slip.",
        ("estimation/motion.py",),
        (Switch(f"{_MOTION}:MotionFaultMonitor._failure", Returns("slip")),),
        Probe(f"{_MOTION}:MotionFaultMonitor._failure", lambda kind, *_: kind != "slip"),
        case="onewheel",
    ),
    Mechanism(
        "doubtful_wheels",
        "Flagged wheels that nothing replaces stay, with a covariance that allows for the fault.",
        ("graph/noise.py",),
        (Switch(f"{_BUDGET}:NoiseBudget._with_slip", Argument(1)),),
        Probe(f"{_BUDGET}:NoiseBudget._with_slip", called),
        batch=True,
        case="foreign",
    ),
    Mechanism(
        "gyro_bias",
        "The gyro's bias is learned while the wheels stand, and between two fixes of the yaw.",
        ("sensors/gyro.py",),
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
        (
            "estimation/tracking.py",
            "estimation/place.py",
            "estimation/beacons.py",
        ),
        (Switch(f"{_WHERE}.search", Returns(None)),),
        Probe(f"{_WHERE}.search", not_none),
        batch=True,
        case="kidnap",
    ),
    Mechanism(
        "lost_by_covariance",
        "A pose too uncertain for any sighting to be judged by makes the robot lost.",
        ("estimation/tracking.py",),
        (Switch(f"{_WHERE}.is_unlocalized", Returns(False)),),
        Probe(f"{_WHERE}.is_unlocalized", something),
        batch=True,
        case="robot_moved",
    ),
    Mechanism(
        "lift",
        "A robot that rises, or turns though it stands, is carried: no source knows its motion.",
        ("estimation/faults.py", "estimation/motion.py"),
        (Switch(f"{_FAULTS}:LiftMonitor.observe", Returns([])),),
        Probe(f"{_FAULTS}:LiftMonitor.observe", something),
        batch=True,
        case="lifted",
    ),
    Mechanism(
        "given_pose_held",
        "A given first pose holds against sightings that contradict it from the start.",
        ("estimation/tracking.py", "estimation/sightings.py"),
        (Switch(f"{_WHERE}.keeps_initial_pose", _never),),
        Probe(f"{_WHERE}.gate_initial_pose", lambda _, before, where, *args: where.keeps_initial_pose),
        batch=True,
        case="given",
    ),
    Mechanism(
        "start_trimming",
        "A place is fitted again to the sightings that it explains.",
        ("estimation/place.py",),
        (Switch("fgloc.estimation.place:MOST_STEPS", Constant(0)),),
        case="ids30",
    ),
    Mechanism(
        "jump_compelling",
        "A place other than the tracked one needs two landmarks, and nearly all sightings of an image or two images.",
        ("estimation/pose_fit.py",),
        (Switch(f"{_CONSENSUS}.overrides_prior", Returns(True)),),
        Probe(f"{_CONSENSUS}.overrides_prior", lambda result, *_: not result),
        batch=True,
        case="ids30",
    ),
)

MECHANISMS: tuple[Mechanism, ...] = (*OF_SIGHTINGS, *OF_MOTION, *OF_TRACKING)
BY_NAME = {m.name: m for m in MECHANISMS}
