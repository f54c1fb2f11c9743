"""Mechanisms that decide on the place, linearize and smooth, for the table of `benchmarks.mechanisms_off`."""

from __future__ import annotations

from typing import Any

from benchmarks.mechanisms_switch import (
    Constant,
    Mechanism,
    Probe,
    Returns,
    Switch,
    not_none,
    something,
)

_GATE = "fgloc.estimation.sightings"
_SEARCH = "fgloc.estimation.place"
_CONSENSUS = "fgloc.estimation.pose_fit:PoseConsensus"
_WHERE = "fgloc.estimation.tracking:Tracking"
_BATCH = "fgloc.graph.batch:BatchSmoother"


def _never(real: Any) -> property:
    return property(lambda self: False)


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
        (Switch("fgloc.estimation.faults:LiftMonitor.observe", Returns([])),),
        Probe("fgloc.estimation.faults:LiftMonitor.observe", something),
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
        (Switch(f"{_SEARCH}:MOST_STEPS", Constant(0)),),
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
