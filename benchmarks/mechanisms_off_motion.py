"""What weighs the motion sources, for the table of `benchmarks.mechanisms_off`."""

from __future__ import annotations

import math
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
from fgloc.faults.motion_faults import Trust
from fgloc.types import FloatArray

_TRUST = "fgloc.faults.motion_faults"
_ARBITER = "fgloc.faults.fault_isolation:Arbiter"
_GYRO = "fgloc.sensors.gyro"
_ROOM = "fgloc.graph.slip_noise:Footing.room"


def _given_trust(real: Function) -> Function:
    return lambda self, dt, readings, off: Trust(off)


def _no_room(slipping: bool) -> Function:
    def off(real: Function) -> Function:
        def room(self: Any, m: Any, slips: bool) -> Any:
            return np.zeros((3, 3)) if slips is slipping else real(self, m, slips)

        return room

    return off


_no_slip_room, _no_loose_room = _no_room(True), _no_room(False)


def _motions_as_given(real: Function) -> Function:
    return lambda self, k, step, motions, sightings: (motions, 1.0, [])


def _learned_alone(real: Function) -> Function:
    return lambda self, wheels, learned: learned


def _summed(real: Function) -> Function:
    def difference_cov(self: Any, W: FloatArray, N: FloatArray) -> FloatArray:
        return W + N

    return difference_cov


def _never_blind(real: Function) -> Function:
    return lambda self, step, wheels, blind_s=0.0: real(self, step, wheels)


def _for_wheels(result: Any, before: Any, arbiter: Any, *args: Any) -> bool:
    return bool(arbiter.sides_with_wheels)


_ARBITER_ACTS = Probe(f"{_ARBITER}._judge", _for_wheels)

OF_MOTION: tuple[Mechanism, ...] = (
    Mechanism(
        "disagreement_test",
        "GLR test of wheels against learned motion or gyro: slipping or dead wheels are left out.",
        ("faults/glr_test.py", "faults/motion_faults.py"),
        (Switch("fgloc.faults.glr_test:Disagreement._worst", Returns((0.0, 1))),),
        Probe("fgloc.faults.glr_test:Disagreement.judge", lambda verdict, *_: verdict.flagged),
        batch=True,
    ),
    Mechanism(
        "onset_reweighing",
        "Steps between the likeliest onset of a fault and its detection are weighed again.",
        ("localizer.py", "graph/estimator.py", "graph/isam2.py"),
        (Switch("fgloc.localizer:Localizer._revise", Returns([])),),
        Probe("fgloc.localizer:Localizer._revise", lambda result, _, self, k, trust: trust.span > 1),
        batch=True,
    ),
    Mechanism(
        "arbiter",
        "Fixes decide which of two disagreeing motion sources is wrong; without it always the wheels are.",
        ("faults/fault_isolation.py",),
        (Switch(f"{_ARBITER}._judge", Returns(None)),),
        _ARBITER_ACTS,
        batch=True,
    ),
    Mechanism(
        "probation",
        "A model that fixes contradicted is used again only after it has agreed for 20 s.",
        ("faults/motion_faults.py",),
        (Switch(f"{_TRUST}:_PROBATION_S", Constant(0.0)),),
        _ARBITER_ACTS,
        batch=True,
    ),
    Mechanism(
        "failure_kind",
        "Tells frozen encoders and one dead wheel from slip.",
        ("faults/motion_faults.py",),
        (Switch(f"{_TRUST}:SourceTrust._failure", Returns("slip")),),
        Probe(f"{_TRUST}:SourceTrust._failure", lambda kind, *_: kind != "slip"),
    ),
    Mechanism(
        "unwitnessed_hold",
        "While the witness is silent the last verdict on the wheels holds for a window.",
        ("faults/motion_faults.py",),
        (Switch(f"{_TRUST}:SourceTrust._unwitnessed", _given_trust),),
        Probe(f"{_TRUST}:SourceTrust._unwitnessed", lambda trust, _, self, dt, readings, off: trust.off != off),
        batch=True,
    ),
    Mechanism(
        "doubtful_wheels",
        "Flagged wheels that nothing replaces stay, with a covariance that allows for the fault.",
        ("fusion/motion.py",),
        (Switch("fgloc.fusion.motion:MotionSources._doubtful", Argument(1)),),
        Probe("fgloc.fusion.motion:MotionSources._doubtful", called),
        batch=True,
    ),
    Mechanism(
        "slip_room",
        "Slip noise during a camera outage while the wheels slip.",
        ("graph/slip_noise.py",),
        (Switch(_ROOM, _no_slip_room),),
        Probe(_ROOM, lambda room, _, footing, m, slips: slips and room.any()),
    ),
    Mechanism(
        "loose_floor_room",
        "Slip noise during a camera outage for 20 s after a slip.",
        ("graph/slip_noise.py",),
        (Switch(_ROOM, _no_loose_room),),
        Probe(_ROOM, lambda room, _, footing, m, slips: not slips and room.any()),
    ),
    Mechanism(
        "outage_inflation",
        "After dead reckoning the interval's covariances grow until the returning sightings are likely.",
        ("graph/outage_inflation.py", "localizer.py"),
        (Switch("fgloc.localizer:Localizer._return", _motions_as_given),),
        Probe("fgloc.localizer:Localizer._return", lambda result, *_: result[1] > 1.0),
        batch=True,
    ),
    Mechanism(
        "source_correlation",
        "Errors of wheels and learned motion are taken as correlated, as calibrated.",
        ("motion/joint.py", "fusion/motion.py"),
        (
            Switch("fgloc.motion.joint:JointCalibration.decorrelate", _learned_alone),
            Switch("fgloc.motion.joint:JointCalibration.difference_cov", _summed),
        ),
        Probe("fgloc.motion.joint:JointCalibration.decorrelate", called),
        batch=True,
    ),
    Mechanism(
        "gyro_rest_bias",
        "The gyro's bias is learned while the wheels stand.",
        ("sensors/gyro.py",),
        (Switch(f"{_GYRO}:Gyro._watch_rest", Returns(None)),),
        Probe(f"{_GYRO}:Gyro._watch_rest", called),
        batch=True,
    ),
    Mechanism(
        "gyro_fix_bias",
        "The gyro's bias is learned between two fixes of the yaw.",
        ("sensors/gyro.py",),
        (Switch(f"{_GYRO}:Gyro.fix", Returns(None)),),
        Probe(f"{_GYRO}:Gyro.fix", called),
        batch=True,
    ),
    Mechanism(
        "gyro_bias_jump",
        "A bias far from the estimate widens its variance instead of entering it.",
        ("sensors/gyro.py",),
        (Switch(f"{_GYRO}:_ALARM", Constant(math.inf)),),
        Probe(
            f"{_GYRO}:Gyro._learn",
            lambda _, before, gyro, *args: gyro.bias_variance > before,
            lambda g, *_: g.bias_variance,
        ),
        batch=True,
    ),
    Mechanism(
        "gyro_drift_room",
        "Variance of the yaw by a wrong bias grows with the square of the time without a fix.",
        ("sensors/gyro.py",),
        (Switch(f"{_GYRO}:Gyro.measure", _never_blind),),
        Probe(f"{_GYRO}:Gyro.measure", called),
        batch=True,
    ),
)
