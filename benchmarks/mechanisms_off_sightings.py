"""Mechanisms that weigh and associate sightings, for the table of `benchmarks.mechanisms_off`."""

from __future__ import annotations

import math

from benchmarks.mechanisms_switch import (
    Argument,
    Mechanism,
    Probe,
    Returns,
    Switch,
    not_none,
    something,
)

_GATE = "fgloc.estimation.sightings"
_POSE_FIT = "fgloc.estimation.pose_fit"
_NO_KERNEL = 1e6  # sigmas
_MODES = "fgloc.estimation.landmark_modes:LandmarkModes"


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
)

OF_LANDMARKS: tuple[Mechanism, ...] = (
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
