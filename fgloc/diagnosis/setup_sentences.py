"""The sentence for each gross mistake, with the line to be set, and the settings with that line."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgloc.config import Config, Role
from fgloc.diagnosis.pose_text import pose_text, sensor_pose
from fgloc.diagnosis.setup_changes import Change, angle_of, k1_of
from fgloc.diagnosis.setup_fit import Setup
from fgloc.diagnosis.setup_motion import EXTRAS
from fgloc.sensors import registry
from fgloc.sensors.roles import SetupMistake, with_values
from fgloc.types import FloatArray, LandmarkMap

_SAID_DEG = 1.0  # degrees: less is not put into words
_LEVEL = 0.2  # horizontal part of a viewing axis: less looks straight up or down and has no roll
_ABOUT_DEG = 20.0  # degrees within which a camera counts as upside down, or as looking backward


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """A sentence that names the mistake and the line to be set, and the settings with that line."""

    sentence: str
    config: Config
    landmark_map: LandmarkMap | None


def correction(change: Change, given: Setup, source: str, image: Role, wheels: Role) -> Correction:
    """The sentence for a change, and the settings with it.

    Args:
        change: that was found.
        given: the set-up.
        source: of wheel motion.
        image: role whose stamps the sightings have.
        wheels: likewise of the wheels.
    """
    values = dict(zip(EXTRAS, change.setup.extras.tolist(), strict=True))
    match change.kind:
        case "size":
            return _size(given, math.exp(values["size"]))
        case "map_scale":
            return _map_scale(given, math.exp(values["map_scale"]))
        case "mirrored" | "ids":
            return _map(change, given)
        case "focal" | "resolution" | "distortion":
            return _lens(change, given)
        case "mounting" | "position":
            return _mounting(change, given)
        case "image_clock":
            return _clock(given, image, "images" if image == "image" else "sightings", values["late_s"])
        case "wheel_clock":
            return _clock(given, wheels, registry.motion_names().odometer, -values["late_s"])
        case "gyro_clock":
            return _clock(given, "imu", registry.motion_names().rate, -values["gyro_late_s"])
        case _:
            return _odometer(change, given, source)


def _size(given: Setup, factor: float) -> Correction:
    sizes = sorted({m.size_m for m in given.landmark_map.landmarks.values() if m.size_m > 0.0})
    shown, line = f"{sizes[0]:.4g} to {sizes[-1]:.4g} m", f"multiply every size by {factor:.4f}"
    if len(sizes) == 1:
        shown, line = f"{sizes[0]:.4g} m", f"set size: {sizes[0] * factor:.4g} for every marker"
    known = {i: replace(m, size_m=factor * m.size_m) for i, m in given.landmark_map.landmarks.items()}
    return Correction(
        f"The markers' size is {shown} by the map, and {factor:.3f} times that by their places and the images: "
        f"{line} in the map.",
        given.config,
        replace(given.landmark_map, landmarks=known),
    )


def _map_scale(given: Setup, factor: float) -> Correction:
    known = {i: replace(m, position=factor * m.position) for i, m in given.landmark_map.landmarks.items()}
    return Correction(
        f"Distances on the map are {1.0 / factor:.3f} times those that wheels and markers show: the map's scale is "
        f"wrong; multiply its positions by {factor:.4f}.",
        given.config,
        replace(given.landmark_map, landmarks=known),
    )


def _map(change: Change, given: Setup) -> Correction:
    if change.kind == "mirrored":
        sentence = (
            "The map is mirrored against what wheels and camera show: change the sign of the y of all its positions "
            "(and of its markers' directions)."
        )
    else:
        before, after = given.landmark_map.landmarks, change.setup.landmark_map.landmarks
        a, b = sorted(i for i in before if not np.array_equal(before[i].position, after[i].position))
        sentence = f"The map has ids {a} and {b} in each other's place: exchange ids {a} and {b} in the map."
    return Correction(sentence, given.config, change.setup.landmark_map)


def _lens(change: Change, given: Setup) -> Correction:
    before, after = given.camera, change.setup.camera
    if change.kind == "distortion":
        k1, k2 = after.D[:2].tolist()
        sentence = (
            f"The camera's distortion is not as given, k1 {k1_of(given):.3g}: by the markers it is about {k1:.3g}; set "
            f"camera.k1: {k1:.3f} and camera.k2: {k2:.3f}, or better calibrate it."
        )
        return Correction(sentence, _set(given.config, "camera", k1=k1, k2=k2), given.landmark_map)
    factor = float(after.K[0, 0] / before.K[0, 0])
    scale = given.config.camera.focal_scale * factor
    line = f"set camera.focal_scale: {scale:.4f}"
    values: dict[str, float] = {"focal_scale": scale}
    if change.kind == "resolution":
        values |= {"cx_px": float(after.K[0, 2]), "cy_px": float(after.K[1, 2])}
        line += f", camera.cx_px: {after.K[0, 2]:.1f} and camera.cy_px: {after.K[1, 2]:.1f}"
        what = "is for another resolution"
    else:
        what = "has the wrong focal length"
    sentence = (
        f"The camera's calibration {what}: {before.K[0, 0]:.1f} px given, {after.K[0, 0]:.1f} px seen; {line}, or "
        "better calibrate it."
    )
    return Correction(sentence, _set(given.config, "camera", **values), given.landmark_map)


def _mounting(change: Change, given: Setup) -> Correction:
    before, after = given.camera.T_base_cam, change.setup.camera.T_base_cam
    config = _set(given.config, "recording", sightings_pose=sensor_pose(after, optical=True), sightings_axes="optical")
    line = f"correct the transform, or set {pose_text(after, optical=True)}"
    if change.kind == "position":
        moved = before[:3, :3].T @ (after[:3, 3] - before[:3, 3])
        x, y, z = moved
        sentence = f"The camera sits {z:+.2f} m ahead, {x:+.2f} m right, {y:+.2f} m below its transform: {line}."
        return Correction(sentence, config, given.landmark_map)
    return Correction(f"The camera {_turned(before, after)}: {line}.", config, given.landmark_map)


def _turned(before: FloatArray, after: FloatArray) -> str:
    """How a camera at ``after (4, 4)`` is turned against its transform ``before (4, 4)``, in words."""
    ahead, given = after[:3, 2], before[:3, 2]
    if min(math.hypot(ahead[0], ahead[1]), math.hypot(given[0], given[1])) < _LEVEL:
        return f"is turned by {math.degrees(angle_of(before[:3, :3].T @ after[:3, :3])):.0f}° against its transform"
    yaw = _degrees(math.atan2(ahead[1], ahead[0]) - math.atan2(given[1], given[0]))
    pitch = _degrees(math.asin(float(np.clip(ahead[2], -1, 1))) - math.asin(float(np.clip(given[2], -1, 1))))
    roll = _degrees(_roll(after) - _roll(before))
    turned, looks = [], []
    if abs(roll) > _SAID_DEG:
        down = abs(abs(roll) - 180.0) < _ABOUT_DEG
        turned.append("is mounted upside down" if down else f"is turned by {abs(roll):.0f}° about its viewing axis")
    if abs(abs(yaw) - 180.0) < _ABOUT_DEG:
        turned.append("looks backward")
    elif abs(yaw) > _SAID_DEG:
        looks.append(f"{abs(yaw):.1f}° further {'left' if yaw > 0 else 'right'}")
    if abs(pitch) > _SAID_DEG:
        looks.append(f"{abs(pitch):.1f}° further {'up' if pitch > 0 else 'down'}")
    sentence = [f"{' and '.join(turned)} against its transform"] if turned else []
    return " and ".join([*sentence, *([f"looks {' and '.join(looks)} than its transform says"] if looks else [])])


def _degrees(angle: float) -> float:
    return math.degrees(math.remainder(angle, 2.0 * math.pi))


def _roll(T: FloatArray) -> float:
    """Of an optical frame about its viewing axis; 0 if its x axis is level."""
    return math.atan2(-T[2, 0], -T[2, 1])


def _clock(given: Setup, role: Role, name: str, late_s: float) -> Correction:
    offsets = dict(given.config.recording.stamp_offset_s)
    offset = offsets.get(role, 0.0) - late_s
    side = "late" if late_s > 0 else "early"
    sentence = (
        f"The stamps of the {name} are {abs(late_s):.3f} s {side} against the others: set recording.stamp_offset_s: "
        f"{{{role}: {offset:.3f}}}."
    )
    return Correction(
        sentence, _set(given.config, "recording", stamp_offset_s=offsets | {role: offset}), given.landmark_map
    )


def _odometer(change: Change, given: Setup, source: str) -> Correction:
    values = dict(zip(EXTRAS, change.setup.extras.tolist(), strict=True))
    mistake = SetupMistake(change.kind, math.exp(values.get(change.kind, 0.0)), change.setup.turned, source)
    found = registry.odometer().correct(mistake, given.config)
    return Correction(found.sentence, _set(given.config, found.section, **found.values), given.landmark_map)


def _set(config: Config, section: str, **values: Any) -> Config:
    return with_values(config, section, values)
