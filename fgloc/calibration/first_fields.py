"""Roles of messages of types that nothing reads, for the first settings: by names of fields, and by how wheels move.

Names tell which numbers are the left and the right wheel, or speed and steering; integers where a counter rolls over.
How far the robot goes for one unit, and its track or wheelbase, follow from what else measures its motion: its turn by
gyro or truth, then its way by truth or landmarks.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgloc.config import Config, JointField, Role, RoleFields, WheelsConfig
from fgloc.diagnosis.landmark_fits import fit_sightings
from fgloc.diagnosis.pairs import TELLS, fit_rate
from fgloc.diagnosis.signals import Path, Signals, turn_by
from fgloc.diagnosis.truth import fit_body
from fgloc.errors import ConfigError
from fgloc.recording.fields import NumericField, in_words
from fgloc.sensors.wheels.events import JointsEvent

_SIDES = {
    "left": re.compile(r"(?<![a-z])(left|l)(?![a-z])|(?<![a-z])l(?=wheel|motor|enc)|\[0\]"),
    "right": re.compile(r"(?<![a-z])(right|r)(?![a-z])|(?<![a-z])r(?=wheel|motor|enc)|\[1\]"),
}
_ASKED = r"c(om)?m(an)?d|target|set_?point|desired|goal|reference|(?<![a-z])(joy|arm)|gripper"  # or not of the robot
_OTHER = re.compile(
    rf"{_ASKED}|pwm|current|torque|effort|power|duty|temp|volt|error|bump|cliff|drop|wall|button|light|sonar|gyro|"
    r"accel|(?<![a-z])(led|range|imu|cam|time)|stamp|seq|flag|fault|lateral|angular"
)
_ENTRIES_OF_WHEELS = re.compile(r"wheel|motor|driver|enc(?![a-z])|encoder|tick|rpm|travel")  # of an array: not of cells
_STEERING, _SPEED = re.compile(r"steer"), re.compile(r"speed|velocity")
_A_TURN = re.compile(r"resolution|per_rev|per_turn|cpr|ppr")  # a field beside the counter, of what makes a turn
_REVOLUTIONS = re.compile(r"(?<!e)rpm")
_WIDTH = re.compile(r"u?int(8|16|32)$")
_MOST_RAD = 1.6  # of a steering in radians
_USUAL_M = 20.0  # way of a wheel in an unknown unit, to begin with
_TURNS = (0.4, 0.7, 1.2, 2.0, 3.5, 6.0, 10.0)  # over those of a track of 1 m: tried where nothing tells the turn
_STAYS = 0.95  # 1 less the share of its distance by which a landmark wanders, if the turn is right
_UNSURE = 0.1  # share of a scale by which it is not known
_OFF = 0.02  # share by which a scale that is as it should be may differ from 1

_RADIO = re.compile(r"uwb|anchor|beacon|link_?track|ranging|dwm|pozyx|decawave|transponder|(?<![a-z])toa(?![a-z])")
_LANDMARKS = re.compile(r"(land)?mark|(april_?|s)?tag|aruco|fiducial|beacon|reflector|bearing")
_ID = re.compile(r"(?<![a-z])ids?$")
_OWN_ID = re.compile(r"tag|requester|source|robot|group|frame")  # of the radio that ranges, or of something else
_RANGE = re.compile(r"(?<![a-z])(range|dis|dist|distance)s?(_from_tag)?$")
_BEARING = re.compile(r"(?<![a-z])(bearing|yaw|azimuth)s?$")
_POSE = re.compile(r"\.(position|translation)\.x$")
_OTHER_TWIST = re.compile(rf"{_ASKED}|(?<![a-z])imu", re.IGNORECASE)
_FORWARD = re.compile(r"(?<![a-z])((linear|longitudinal)_(velocity|vel|speed|x)|linear\.x)$")
_TURN = re.compile(r"(?<![a-z])((angular|rotational)_(velocity|vel|speed|z)|(heading|yaw|turn)_rate|angular\.z)$")


def find_roles(unread: Mapping[str, Mapping[str, str]], taken: Set[Role]) -> dict[str, RoleFields]:
    """Roles that fields of messages play by their names: an odometry of speed and yaw rate, sightings, ranges.

    Args:
        unread: types of the numbers by path, by topic.
        taken: roles that topics play already.
    """
    found: dict[str, RoleFields] = {}
    for topic, kinds in sorted(unread.items()):
        names = {path: in_words(path).replace("[]", "") for path in kinds}
        forward, turn = (
            [p for p, name in names.items() if "[" not in p and of.search(name)] for of in (_FORWARD, _TURN)
        )
        robot = not _OTHER_TWIST.search(" ".join((topic, *(names[p] for p in (*forward, *turn)))))
        if len(forward) == len(turn) == 1 and robot and not taken & {"odometry", "joints"}:
            found.setdefault("odometry", RoleFields(topic=topic, forward=forward[0], turn=turn[0]))
        for id_path in (p for p, name in names.items() if _ID.search(name) and "int" in kinds[p]):
            beside = {p: name for p, name in names.items() if p != id_path and _entry(p) == _entry(id_path)}
            ranges, bearings = ([p for p, name in beside.items() if of.search(name)] for of in (_RANGE, _BEARING))
            poses = [p[: m.start()] for p in kinds if (m := _POSE.search(p)) and _entry(p) == _entry(id_path)]
            about = in_words(" ".join((topic, *kinds)))
            role, fields = "", {}
            if len(ranges) == len(bearings) == 1:
                role, fields = "sightings", {"range": ranges[0], "bearing": bearings[0]}
            elif len(poses) == 1 and not ranges:
                role, fields = "sightings", {"pose": poses[0]}
            elif len(ranges) == 1 and not poses and not _OWN_ID.search(names[id_path]):
                role, fields = "uwb", {"range": ranges[0]}
            usual = _RADIO if role == "uwb" else _LANDMARKS
            free = topic not in {one.topic for one in found.values()}  # a topic plays one role
            free &= not taken & ({"uwb"} if role == "uwb" else {"image", "sightings"})
            if role and free and usual.search(about):
                found.setdefault(role, RoleFields(topic=topic, id=id_path, **fields))
    return found


def _entry(path: str) -> str:
    """Array whose entries a path is of; arrays of numbers that lie beside one another count as one."""
    return path.rpartition(".")[0] + "[]" if path.endswith("[]") else path.rpartition("[]")[0]


@dataclass(frozen=True, slots=True)
class FirstWheels:
    """Joints that the fields of a recording's messages are, by name, and the section of the wheels.

    Attributes:
        joints: left and right, or speed and steering_angle; empty: none, or another motion refutes them.
        wheels: keys of the section `wheels`, as far as they are known; empty: nothing shows the geometry.
        why: what showed it.
    """

    joints: Mapping[str, JointField]
    wheels: Mapping[str, Any]
    why: str = ""


def find_joints(numbers: Sequence[NumericField]) -> dict[str, JointField]:
    """Joints "left" and "right", or "speed" and "steering_angle", that names tell; empty: they do not."""
    moving = [n for n in numbers if n.low < n.high and not _OTHER.search(n.name)]
    pairs = [(a, b) for a in moving for b in moving if _side(a, "left") and _side(a, "left") == _side(b, "right")]
    pairs = [(a, b) for a, b in pairs if a.is_of_wheels and not ("[0]" in a.path and _may_be_others(a, moving))]
    if pairs:
        left, right = min(pairs, key=lambda pair: pair[0].is_rate)  # angles before rates: none is lost with a message
        return {"left": _joint(left, numbers), "right": _joint(right, numbers)}
    steering = [n for n in moving if _STEERING.search(n.name) and not n.is_rate] or [
        n for n in moving if _STEERING.search(n.path) and not re.search("vel|rate", n.path)
    ]
    speeds = [n for n in moving if _SPEED.search(n.path) and not _STEERING.search(n.path)]
    if len(steering) == len(speeds) == 1:
        angle = _joint(steering[0], numbers, rate=False)
        degrees = max(-steering[0].low, steering[0].high) > _MOST_RAD
        scale = float(f"{math.pi / 180.0:.6g}") if degrees else 1.0
        return {"speed": _joint(speeds[0], numbers), "steering_angle": angle.model_copy(update={"scale": scale})}
    return {}


def _may_be_others(first: NumericField, moving: Sequence[NumericField]) -> bool:
    """Whether entries of an array may be other numbers, or more wheels than two, of which places are not known."""
    third = first.name.replace("[0]", "[2]")
    return not _ENTRIES_OF_WHEELS.search(first.name) or any(n.name == third for n in moving)


def _side(number: NumericField, side: str) -> str:
    """Name of a field without the word that makes it one of this side; empty: it is not."""
    name, count = _SIDES[side].subn("#", number.name)
    return name if count else ""


def _joint(number: NumericField, numbers: Sequence[NumericField], rate: bool | None = None) -> JointField:
    """Field of a joint; in radians where its name or a field beside it tells, else in its own unit."""
    scale, folder = 1.0, number.path.rpartition(".")[0]
    for n in numbers:
        beside = n.topic == number.topic and n.path.rpartition(".")[0] == folder
        if beside and n.low == n.high > 1.0 and _A_TURN.search(n.name):
            scale = math.tau / n.high
    if rate or (rate is None and number.is_rate):
        scale = math.tau / 60.0 if _REVOLUTIONS.search(number.name) else 1.0
        return JointField(topic=number.topic, velocity=number.path, scale=float(f"{scale:.6g}"))
    width = _WIDTH.match(number.kind)
    rolls_over = 2.0 ** int(width[1]) if width else None
    return JointField(topic=number.topic, position=number.path, scale=float(f"{scale:.6g}"), rolls_over=rolls_over)


def fit_wheels(joints: Mapping[str, JointField], signals: Signals, config: Config) -> FirstWheels:
    """Signs, unit and geometry of the wheels by what else in the recording measures motion.

    Args:
        joints: as `find_joints` has them.
        signals: of the recording, with these joints.
        config: with which they were read.
    """
    unit = _unit(signals, next(iter(joints)))
    try:
        found = [one for signs in _SIGNS if (one := _turned(signals, config, joints, signs, unit)) is not None]
    except ConfigError:  # a run cannot use them either: their first values are no numbers
        return FirstWheels({}, {})
    if not found:  # another motion refutes them, or there is none
        return FirstWheels({} if len(signals.imu) + len(signals.truth) > 0 else joints, {})
    _, by, path, turns, sign = max(found, key=lambda one: one[0])
    way = _way(path.turned(turns), signals)
    if way is None:
        return FirstWheels(joints, {})
    size, span, why = unit * way[0], way[0] / abs(turns), f"the turn by {by}, the way by {way[1]}"
    if "speed" in joints:
        angle = _scaled(joints["steering_angle"], math.copysign(1.0, turns))
        joints = {"speed": _scaled(joints["speed"], size), "steering_angle": angle}
        return FirstWheels(joints, {"drive": {"kind": "ackermann", "wheelbase": _rounded(span)}}, why)
    left, right = joints.values()
    if turns < 0.0 and "[0]" in str(left):  # of an array the order is not known, of names the sign is not
        left, right = right, left
    elif turns < 0.0:
        size = -size
    signed = {"left": (left, size), "right": (right, sign * size)}
    known = left.scale != 1.0  # else metres, with a radius of 1
    joints = {name: joint if known else _scaled(joint, factor) for name, (joint, factor) in signed.items()}
    radii = {f"{name}_radius": _rounded(factor) if known else 1.0 for name, (_, factor) in signed.items()}
    named = {"source": "ticks", "left_joint": "left", "right_joint": "right"}
    return FirstWheels(joints, {**named, **radii, "track": _rounded(span)}, why)


_SIGNS = (1.0, -1.0)  # of the right wheel if the left one counts forward: motors may face one another


def _unit(signals: Signals, name: str) -> float:
    """Metres for one unit of a joint with which the robot goes a usual way."""
    joints = sorted((e for e in signals.motion if isinstance(e, JointsEvent)), key=lambda e: e.stamp_ns)
    angles, rates = (np.array([e.of((name,), of)[0] for e in joints]) for of in ("position", "velocity"))
    seconds = np.array([e.stamp_ns for e in joints]) * 1e-9
    steps = np.diff(angles) if np.isfinite(angles).any() else rates[1:] * np.diff(seconds)
    return _USUAL_M / max(float(np.nansum(np.abs(steps))), 1e-9)


def _turned(
    signals: Signals, config: Config, joints: Mapping[str, JointField], sign: float, unit: float
) -> tuple[float, str, Path, float, float] | None:
    """Share of the robot's turn that such wheels explain, by what, their path, turn over theirs, sign; None: nothing.

    The path is that of wheels of a usual way and a track, or wheelbase, of 1 m.
    """
    if "speed" in joints:
        wheels: dict[str, Any] = {"drive": {"kind": "ackermann", "radius": unit, "wheelbase": 1.0}}
    else:
        wheels = {"source": "ticks", "left_joint": "left", "right_joint": "right", "track": 1.0}
        wheels |= {"left_radius": unit, "right_radius": sign * unit}
    config = config.model_copy(update={"wheels": WheelsConfig.model_validate(wheels)})
    path, rates, truth = signals.path(config), signals.rates(), signals.true_poses()
    if path is None:
        return None
    turns = []
    if rates is not None:
        up = rates[2].mean(axis=0)
        up = up / size if (size := float(np.linalg.norm(up))) > 1.0 else np.array([0.0, 0.0, 1.0])
        turns.append(("the gyro", rates[0], turn_by(rates[0], rates[1] @ up)))
    if truth is not None and signals.true_yaw:
        turns.append(("the truth", truth[:, 0], truth[:, 3]))
    for by, times, turn in turns:
        fit = fit_rate(path, times, turn)
        if fit is not None and fit.share > TELLS:
            return fit.share, by, path, 1.0 / fit.scale.value, sign
    seen = signals.sightings()
    if turns or seen is None:
        return None
    axes = ["body", "optical"] if seen.spatial else ["body"]
    tried = [(factor, fit_sightings(path.turned(factor), seen, axes, turn_sigma=1.0)) for factor in _TURNS]
    fits = [
        (m.misfit, factor * m.turns.value) for factor, found in tried for m in found.values() if m.turns.value > 0.0
    ]
    misfit, factor = min(fits, default=(math.inf, 1.0))
    share = 1.0 - misfit / float(np.median(np.linalg.norm(seen.points, axis=1)))
    return (share, "the landmarks", path, factor, sign) if share > _STAYS else None


def _way(path: Path, signals: Signals) -> tuple[float, str] | None:
    """Metres for each metre of a path that turns as the robot does, and by what; None: nothing tells."""
    truth, seen, size = signals.true_poses(), signals.sightings(), 1.0
    for _ in range(2 if seen is not None else 0):  # the place of the sensor is sought within metres
        assert seen is not None
        fits = fit_sightings(replace(path, poses=path.poses * np.array([size, size, 1.0])), seen)
        best = min(fits.values(), key=lambda m: m.misfit, default=None)
        if best is None or best.scale.sigma > _UNSURE * best.scale.value:
            break
        size /= best.scale.value
    else:
        if seen is not None:
            return size, "the landmarks"
    if truth is not None and (body := fit_body(path, truth)) is not None and body.share > TELLS:
        return body.scale.value, "the truth"
    return None


def _scaled(joint: JointField, factor: float) -> JointField:
    """The joint in another unit; one that is right to a few per cent stays as it is."""
    return joint if abs(factor - 1.0) < _OFF else joint.model_copy(update={"scale": _rounded(joint.scale * factor)})


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
