"""Mechanisms that weigh the motion sources, for the table of `benchmarks.mechanisms_off`."""

from __future__ import annotations

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
)
from fgloc.graph.noise import NoiseBudget

_TRUST = "fgloc.estimation.motion"
_BUDGET = "fgloc.graph.noise"


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


OF_MOTION: tuple[Mechanism, ...] = (
    Mechanism(
        "disagreement_test",
        "GLR test of wheels against learned motion or gyro: slipping or dead wheels are left out.",
        ("estimation/faults.py", "estimation/motion.py"),
        (Switch("fgloc.estimation.faults:GlrTest._nis_of_windows", Returns(np.zeros(1))),),
        Probe("fgloc.estimation.faults:GlrTest.judge", lambda verdict, *_: verdict.flagged),
        batch=True,
        case="onewheel",
    ),
    Mechanism(
        "fault_attribution",
        "Where wheels and learned motion differ, the one that sightings contradict is left out.",
        ("estimation/faults.py", "estimation/motion.py"),
        (Switch("fgloc.estimation.faults:FaultAttribution.contradicted", Returns(None)),),
        Probe("fgloc.estimation.faults:FaultAttribution.contradicted", _model_contradicted),
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
        (Switch("fgloc.estimation.faults:GlrTest._level", _as_given),),
        Probe("fgloc.estimation.faults:GlrTest.judge", lambda _, before, test, *args: test._level < 1.0),
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
        (Switch("fgloc.estimation.motion:MotionJudge._revise", Returns(())),),
        Probe("fgloc.estimation.motion:MotionJudge._revise", lambda result, _, self, verdict: verdict.span > 1),
        batch=True,
        case="foreign",
    ),
    Mechanism(
        "failure_kind",
        "Distinguishes frozen encoders and one dead wheel from slip.",
        ("estimation/motion.py",),
        (Switch(f"{_TRUST}:MotionFaultMonitor._failure", Returns("slip")),),
        Probe(f"{_TRUST}:MotionFaultMonitor._failure", lambda kind, *_: kind != "slip"),
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
