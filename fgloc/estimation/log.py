"""Rows of ``steps.csv`` on motion, places, mountings, modes and the clock, and sentences for the user."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from fgloc import se2
from fgloc.config import BESIDE
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import NoiseBudget
from fgloc.sensors import registry
from fgloc.sensors.measurements import sensor_name
from fgloc.types import MOUNTING_CHANGED, Decision, FloatArray, Grave, Mode, MotionMeasurement, MotionReadings

JUMP = "jump"  # reasons of places that the run went to: one that nothing connects with the pose before ...
OVERRULED = "overruled by sightings"  # ... and one nearby, which the motion did not lead to

_REASONS = {
    "slip": "they slipped",
    "frozen": "they stood still while the robot moved",
    "left_wheel_dead": "the left wheel's encoder stood still",
    "right_wheel_dead": "the right wheel's encoder stood still",
    "doubted": "nothing told whether they or the motion model were wrong, and both were doubted",
}
_OF_BESIDE = {
    "frozen": "it stood still while the robot moved",
    "jumped": "its pose jumped",
    "restarted": "it began again at its origin",
    "deviates": "it went elsewhere",
}


def motion_decisions(
    k: int,
    motions: Sequence[MotionMeasurement],
    readings: MotionReadings,
    budget: NoiseBudget,
    glr: float = math.nan,
    alarm: float = math.nan,
) -> list[Decision]:
    """Rows of ``steps.csv`` for the motion of a step: the residual is that against the wheels.

    That of the wheels is the statistic ``glr`` of the GLR test, if there is one, and its threshold the ``alarm``.

    Rejected sources have weight 0, and so have all the others where sightings overruled them, as they no longer hold
    the pose. Otherwise the weight is one over the factor on the covariance. A step that was judged again has more than
    one row for a source; the last one holds.
    """
    rows = []
    overruled = "" if budget.overruled_cov is None else OVERRULED
    used = {m.source: m for m in motions}
    unknown = [m for m in motions if m.source == "unknown"]
    for reading in (readings.wheels, readings.learned, readings.gyro, *readings.beside, *unknown):
        source = "" if reading is None else reading.source
        why = budget.rejected.get(source, overruled)
        if reading is None or (source not in used and not why):
            continue
        nis, threshold, shift = 0.0, math.nan, math.nan
        reference = readings.learned if reading is readings.wheels else readings.wheels
        if reading is readings.wheels and math.isfinite(glr):
            nis, threshold = glr, alarm
        if reference is not None:
            difference: FloatArray = se2.log(se2.between(reference.motion, reading.motion))
            shift = math.nan if reading is readings.gyro else float(difference[0])
            if reading is not readings.wheels:
                nis = float(difference @ np.linalg.solve(reference.cov + reading.cov, difference))
        weight = 0.0 if why else 1.0 / budget.scales.get(source, 1.0)
        rows.append(Decision(k, reading.stamp_ns, source, -1, nis**0.5, nis, se2.DOF, weight, why, threshold, shift))
    return rows


def place_decision(
    k: int, stamp_ns: int, estimated: PoseWithCovariance, place: PoseWithCovariance, reason: str
) -> Decision:
    """Row of ``steps.csv`` for a pose by sightings, against the predicted one; weight 0: the run did not go there."""
    miss = se2.log(se2.between(estimated.pose, place.pose))
    nis = float(miss @ np.linalg.solve(estimated.cov + place.cov, miss))
    weight = 1.0 if reason in (JUMP, OVERRULED) else 0.0
    shift = math.hypot(miss[0], miss[1])
    return Decision(k, stamp_ns, "place", -1, math.sqrt(nis), nis, se2.DOF, weight, reason, shift_m=shift)


def moved_decision(k: int, stamp_ns: int, landmark_id: int, evidence: float, alarm: float) -> Decision:
    """The row for a landmark that was found to be moved."""
    return Decision(k, stamp_ns, "place", landmark_id, math.sqrt(evidence), evidence, 2, 1.0, "landmark_moved", alarm)


def mounting_decision(k: int, stamp_ns: int, kind: str, evidence: float) -> Decision:
    """The row for a sensor whose mounting changed, by the kind of its sightings."""
    return Decision(k, stamp_ns, kind, -1, math.sqrt(evidence), evidence, se2.DOF, 1.0, MOUNTING_CHANGED)


def mode_decisions(k: int, stamp_ns: int, mode: Mode, since_fix_s: float, after_s: float) -> tuple[Decision, ...]:
    """The row of a pose that is not ``OK``: its residual is the time without an accepted sighting [s]."""
    if mode is Mode.OK:
        return ()
    threshold = after_s if mode is Mode.DEAD_RECKONING else math.nan
    return (Decision(k, stamp_ns, "mode", -1, since_fix_s, math.nan, 0, 0.0, mode.value.lower(), threshold),)


def segment_decision(k: int, stamp_ns: int) -> Decision:
    """The row of the first step after the clock jumped."""
    return Decision(k, stamp_ns, "clock", -1, math.nan, math.nan, 0, 0.0, "new_segment")


def moved_notes(displacements: Mapping[int, FloatArray]) -> Iterator[str]:
    """Sentence for each landmark that was found to be moved and is not used."""
    for landmark_id, moved in displacements.items():
        yield (
            f"marker {landmark_id} does not stand where the map has it: it seems to be {math.hypot(*moved):.2f} m "
            f"off (x {moved[0]:+.2f}, y {moved[1]:+.2f}) and was not used; correct the map or take it down"
        )


def mounting_notes(remounted: Mapping[str, int]) -> Iterator[str]:
    """Sentence for each sensor that was knocked."""
    for kind, stamp_ns in remounted.items():
        yield Grave(
            f"{sensor_name(kind)} was knocked: its mounting is another one since stamp {stamp_ns * 1e-9:.1f} s, and "
            "was found again; fix the sensor, and calibrate it where it is now"
        )


def flag_notes(flags: Mapping[str, int]) -> Iterator[str]:
    """Sentence for each source that was flagged, with the number of flags; keys are "source.reason"."""
    for kind, n in sorted(flags.items()):
        source, _, reason = kind.rpartition(".")
        beside = source.startswith(BESIDE)
        name, why = (source, _OF_BESIDE[reason]) if beside else (f"the {registry.title_of(source)}", _REASONS[reason])
        yield f"{name} disagreed with the other motion sources {n} time(s): {why}"
