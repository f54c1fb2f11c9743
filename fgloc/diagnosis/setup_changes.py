"""The gross mistakes that are looked for: what each changes in a set-up, and the sentence with the line that undoes it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fgloc.config import Config, Role
from fgloc.diagnosis.pose_text import OPTICAL_TO_BODY, pose_text, sensor_pose
from fgloc.diagnosis.setup_fit import EXTRAS, Fit, Setup
from fgloc.frames import rotation_of, rpy_matrix
from fgloc.types import FloatArray, Landmark, LandmarkMap

_WIDE = 0.5  # prior sigma of what may be grossly off: a share, rad, m or s
_LEAST = {  # smaller deviations are an ordinary installation's, which the run estimates; at least five of its sigmas
    "size": 0.025,
    "map_scale": 0.02,
    "radius": 0.05,
    "track": 0.08,
    "camera.focal": 0.025,
    "camera.k1": 0.03,
    "rotation": math.radians(2.0),
    "position": 0.03,
    "late": 0.08,
}
_UPSIDE_DOWN = math.radians(20.0)
_MOST_SWAPS = 4  # of the worst markers, each with each
_SUSPECT = 3.0  # times the median squared residual of a marker


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One mistake undone.

    Attributes:
        kind: names the function that makes the sentence.
        setup: with the mistake undone, where it is a definite one.
        free: prior sigmas of what it leaves to be found.
    """

    kind: str
    setup: Setup
    free: Mapping[str, float] = field(default_factory=dict)

    @property
    def linearized(self) -> bool:
        """Whether the fit knows it to first order only."""
        return "camera.rx_rad" in self.free


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """A sentence that names the mistake and the line to be set, and the settings with that line."""

    sentence: str
    config: Config
    landmark_map: LandmarkMap | None


def changes(setup: Setup, fit: Fit | None, source: str, has_gyro: bool) -> Iterator[Change]:
    """All that is tried on a set-up.

    Args:
        setup: as given.
        fit: of it; None if there is none.
        source: of wheel motion: "ticks" or "odometry"; others tell nothing of wheels.
        has_gyro: whether clocks of wheels and camera can be told apart.
    """
    yield Change("size", setup, {"size": _WIDE})
    yield Change("map_scale", setup, {"map_scale": _WIDE})
    yield Change("distortion", setup, {"camera.k1": _WIDE, "camera.k2": _WIDE})
    yield Change("focal", setup, {"camera.focal": _WIDE})
    for factor in (0.5, 2.0):
        yield Change("resolution", _scaled(setup, factor), {"camera.focal": 0.02})
    turned = {f"camera.r{axis}_rad": _WIDE for axis in "xyz"}
    yield Change("mounting", setup, turned)
    yield from (Change("mounting", _mounted(setup, T), turned) for T in _mountings(setup.camera.T_base_cam))
    yield Change("position", setup, {f"camera.{axis}_m": _WIDE for axis in "xyz"})
    yield Change("mirrored", replace(setup, landmark_map=mirrored(setup.landmark_map)))
    for a, b in _swaps(fit) if fit is not None else ():
        yield Change("ids", replace(setup, landmark_map=swapped(setup.landmark_map, a, b)))
    moving = source in ("ticks", "odometry")
    for start in (0.0, 0.6, -0.6):
        yield Change("image_clock", _with(setup, late_s=start, gyro_late_s=start), {"late_s": 1.0, "gyro_late_s": 1.0})
        if has_gyro:
            yield Change("gyro_clock", _with(setup, gyro_late_s=start), {"gyro_late_s": 1.0})
        if has_gyro and moving:
            yield Change("wheel_clock", _with(setup, late_s=start), {"late_s": 1.0})
    if not moving:
        return
    for start in (0.0, math.log(0.5), math.log(2.0)):
        yield Change("radius", _with(setup, radius=start), {"radius": 1.0})
    yield Change("track", setup, {"track": _WIDE})
    for kind, signs in (("exchanged", (1, 1, -1)), ("reversed", (-1, -1, -1)), ("both_reversed", (-1, -1, 1))):
        yield Change(kind, replace(setup, turned=np.diag(np.array(signs, dtype=float))))
    if source == "odometry":
        yield from (Change("odometry_frame", replace(setup, turned=_about_z(d))) for d in (90.0, -90.0, 180.0))


# --- taking in what was found ---


def refined(change: Change, fit: Fit) -> Change:
    """The change with what was found of it taken into the set-up: the next fit starts there."""
    setup, values = change.setup, {name: fit.values[name][0] for name in fit.values}
    camera, extras = setup.camera, setup.extras.copy()
    for name in change.free:
        if name in EXTRAS:
            extras[EXTRAS.index(name)] = values[name]
    K, D, T = camera.K.copy(), np.concatenate([camera.D, np.zeros(4)])[: max(4, len(camera.D))], camera.T_base_cam.copy()
    if "camera.focal" in change.free:
        K[[0, 1], [0, 1]] *= 1.0 + values["camera.focal"]
    if "camera.k1" in change.free:
        D[:2] += values["camera.k1"], values["camera.k2"]
    if "camera.rx_rad" in change.free:
        T[:3, :3] = T[:3, :3] @ rotation_of(np.array([values[f"camera.r{axis}_rad"] for axis in "xyz"]))
    if "camera.x_m" in change.free:
        T[:3, 3] += T[:3, :3] @ np.array([values[f"camera.{axis}_m"] for axis in "xyz"])
    return replace(change, setup=replace(setup, camera=replace(camera, K=K, D=D, T_base_cam=T), extras=extras))


def gross(change: Change, given: Setup) -> bool:
    """Whether a change that was found is more than an ordinary installation's error."""
    setup, kind = change.setup, change.kind
    values = dict(zip(EXTRAS, setup.extras.tolist(), strict=True))
    if kind in ("size", "map_scale", "radius", "track"):
        return abs(values[kind]) > _LEAST[kind]
    if kind.endswith("_clock"):
        return abs(values["gyro_late_s" if kind == "gyro_clock" else "late_s"]) > _LEAST["late"]
    if kind in ("focal", "resolution"):
        return abs(setup.camera.K[0, 0] / given.camera.K[0, 0] - 1.0) > _LEAST["camera.focal"]
    if kind == "distortion":
        return abs(_k1(setup) - _k1(given)) > _LEAST["camera.k1"]
    if kind == "mounting":
        return _angle(given.camera.T_base_cam[:3, :3].T @ setup.camera.T_base_cam[:3, :3]) > _LEAST["rotation"]
    if kind == "position":
        moved = setup.camera.T_base_cam[:3, 3] - given.camera.T_base_cam[:3, 3]
        return float(np.linalg.norm(moved)) > _LEAST["position"]
    return True


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
        case "radius" | "track":
            return _geometry(change.kind, values, given, source)
        case "image_clock":
            return _clock(given, image, "images" if image == "image" else "sightings", values["late_s"])
        case "wheel_clock":
            return _clock(given, wheels, "wheels", -values["late_s"])
        case "gyro_clock":
            return _clock(given, "imu", "gyro", -values["gyro_late_s"])
        case _:
            return _wheels(change, given, source)


# --- sentences ---


def _size(given: Setup, factor: float) -> Correction:
    sizes = sorted({m.size_m for m in given.landmark_map.landmarks.values() if m.size_m > 0.0})
    line = f"set size: {sizes[0] * factor:.4g}" if len(sizes) == 1 else f"multiply every size by {factor:.4f}"
    shown = f"{sizes[0]:.4g} m" if len(sizes) == 1 else f"{sizes[0]:.4g} to {sizes[-1]:.4g} m"
    known = {i: replace(m, size_m=factor * m.size_m) for i, m in given.landmark_map.landmarks.items()}
    return Correction(
        f"The markers' size is {shown} by the map, and {factor:.3f} times that by what the camera sees of their places: "
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
        said = (
            "The map is mirrored against what wheels and camera show: change the sign of the y of all its positions "
            "(and of its markers' directions)."
        )
    else:
        before, after = given.landmark_map.landmarks, change.setup.landmark_map.landmarks
        a, b = sorted(i for i in before if not np.array_equal(before[i].position, after[i].position))
        said = f"The map has ids {a} and {b} in each other's place: exchange ids {a} and {b} in the map."
    return Correction(said, given.config, change.setup.landmark_map)


def _lens(change: Change, given: Setup) -> Correction:
    before, after = given.camera, change.setup.camera
    if change.kind == "distortion":
        k1, k2 = after.D[:2].tolist()
        said = (
            f"The camera's distortion is not as given, k1 {_k1(given):.3g}: by the markers it is about {k1:.3g}; set "
            f"camera.k1: {k1:.3f} and camera.k2: {k2:.3f}, or better calibrate it."
        )
        return Correction(said, _set(given.config, "camera", k1=k1, k2=k2), given.landmark_map)
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
    said = (
        f"The camera's calibration {what}: {before.K[0, 0]:.1f} px is given and {after.K[0, 0]:.1f} px seen; {line}, or "
        "better calibrate it."
    )
    return Correction(said, _set(given.config, "camera", **values), given.landmark_map)


def _mounting(change: Change, given: Setup) -> Correction:
    before, after = given.camera.T_base_cam, change.setup.camera.T_base_cam
    config = _set(
        given.config, "recording", sightings_pose=sensor_pose(after, optical=True), sightings_axes="optical"
    )
    line = f"correct the transform, or set {pose_text(after, optical=True)}"
    if change.kind == "position":
        moved = before[:3, :3].T @ (after[:3, 3] - before[:3, 3])
        x, y, z = moved
        said = f"The camera sits {z:+.2f} m ahead, {x:+.2f} m to the right and {y:+.2f} m below its transform: {line}."
        return Correction(said, config, given.landmark_map)
    return Correction(f"The camera {_turned(before, after)}: {line}.", config, given.landmark_map)


def _turned(before: FloatArray, after: FloatArray) -> str:
    """How a camera looks, against its transform."""
    ahead = after[:3, 2]
    flat = math.hypot(ahead[0], ahead[1]) > 0.2 and math.hypot(before[0, 2], before[1, 2]) > 0.2
    if not flat:
        angle = math.degrees(_angle(before[:3, :3].T @ after[:3, :3]))
        return f"is turned by {angle:.0f}° against its transform"
    yaw = math.degrees(
        math.remainder(
            math.atan2(ahead[1], ahead[0]) - math.atan2(before[1, 2], before[0, 2]),
            2.0 * math.pi,
        )
    )
    pitch = math.degrees(math.asin(float(np.clip(ahead[2], -1, 1))) - math.asin(float(np.clip(before[2, 2], -1, 1))))
    roll = math.degrees(math.remainder(_roll(after) - _roll(before), 2.0 * math.pi))
    said = []
    if abs(roll) > 1.0:
        down = abs(abs(roll) - 180.0) < math.degrees(_UPSIDE_DOWN)
        said.append("is mounted upside down" if down else f"is turned by {abs(roll):.0f}° about its viewing axis")
    if abs(yaw) > 1.0:
        side = "backward" if abs(abs(yaw) - 180.0) < 20.0 else f"{abs(yaw):.1f}° further {'left' if yaw > 0 else 'right'}"
        said.append(f"looks {side}")
    if abs(pitch) > 1.0:
        said.append(f"looks {abs(pitch):.1f}° further {'up' if pitch > 0 else 'down'}")
    return f"{' and '.join(said) or 'is turned'} against its transform"


def _roll(T: FloatArray) -> float:
    """Of an optical frame about its viewing axis; 0 if its x axis is level."""
    return math.atan2(-T[2, 0], -T[2, 1])


def _geometry(kind: str, values: Mapping[str, float], given: Setup, source: str) -> Correction:
    wheels, factor = given.config.wheels, math.exp(values[kind])
    if kind == "track":
        if source == "ticks" and wheels.track is not None:
            new = {"track": wheels.track * factor}
        else:
            new = {"scale_omega": wheels.scale_omega / factor}
        what = "The wheels turn the robot"
        how = f"{1.0 / factor:.3f} times as far as given: set {_lines(new)}."
        return Correction(f"{what} {how}", _set(given.config, "wheels", **new), given.landmark_map)
    if source == "ticks" and wheels.left_radius is not None and wheels.right_radius is not None:
        new = {"left_radius": wheels.left_radius * factor, "right_radius": wheels.right_radius * factor}
        said = f"The wheels' radii are {factor:.3f} times those given: set {_lines(new)}."
    else:
        new = {"scale_v": wheels.scale_v * factor, "scale_omega": wheels.scale_omega * factor}
        said = f"The robot moves {factor:.3f} times as far as its odometry says: set {_lines(new)}."
    return Correction(said, _set(given.config, "wheels", **new), given.landmark_map)


def _lines(values: Mapping[str, float]) -> str:
    return " and ".join(f"wheels.{name}: {value:.4g}" for name, value in values.items())


def _clock(given: Setup, role: Role, name: str, late_s: float) -> Correction:
    offsets = dict(given.config.recording.stamp_offset_s)
    offset = offsets.get(role, 0.0) - late_s
    side = "late" if late_s > 0 else "early"
    said = (
        f"The stamps of the {name} are {abs(late_s):.3f} s {side} against the others: set recording.stamp_offset_s: "
        f"{{{role}: {offset:.3f}}}."
    )
    return Correction(
        said, _set(given.config, "recording", stamp_offset_s=offsets | {role: offset}), given.landmark_map
    )


def _wheels(change: Change, given: Setup, source: str) -> Correction:
    wheels = given.config.wheels
    if change.kind == "odometry_frame":
        c, s = change.setup.turned[:2, 0]
        angle = math.degrees(math.atan2(s, c))
        said = (
            f"The odometry's twist is in axes that are turned by {-angle:.0f}° against the base: set wheels.source: pose, "
            "or correct its child_frame_id."
        )
        return Correction(said, _set(given.config, "wheels", source="pose"), given.landmark_map)
    if source == "ticks" and change.kind == "exchanged" and wheels.left_joint and wheels.right_joint:
        said = (
            "The left and the right wheel are exchanged: set wheels.left_joint: "
            f"{wheels.right_joint} and wheels.right_joint: {wheels.left_joint}."
        )
        new = {"left_joint": wheels.right_joint, "right_joint": wheels.left_joint}
        return Correction(said, _set(given.config, "wheels", **new), given.landmark_map)
    how = {
        "exchanged": "turn the robot the other way (left and right exchanged)",
        "reversed": "turn backward when the robot goes forward",
        "both_reversed": "turn backward when the robot goes forward, and left and right are exchanged",
    }[change.kind]
    line = "exchange wheels.left_joint and wheels.right_joint, or correct the driver's signs"
    return Correction(f"The wheels {how}: {line}.", given.config, given.landmark_map)


# --- changes ---


def mirrored(landmark_map: LandmarkMap) -> LandmarkMap:
    """The map with the sign of y changed; markers keep upright."""
    flip = np.diag([1.0, -1.0, 1.0])
    across = np.diag([-1.0, 1.0, 1.0])
    known = {
        i: replace(m, position=flip @ m.position, rotation=flip @ m.rotation @ across, cov=None)
        for i, m in landmark_map.landmarks.items()
    }
    return replace(landmark_map, landmarks=known)


def swapped(landmark_map: LandmarkMap, a: int, b: int) -> LandmarkMap:
    """The map with two landmarks in each other's place."""
    known: dict[int, Landmark] = dict(landmark_map.landmarks)
    known[a], known[b] = replace(known[b], landmark_id=a), replace(known[a], landmark_id=b)
    return replace(landmark_map, landmarks=known)


def _swaps(fit: Fit) -> Iterator[tuple[int, int]]:
    """Pairs of the markers that fit worst."""
    typical = float(np.median(list(fit.markers.values())))
    worst = sorted(fit.markers, key=lambda i: -fit.markers[i])[:_MOST_SWAPS]
    bad = [i for i in worst if fit.markers[i] > _SUSPECT * max(typical, 1e-3)]
    yield from ((a, b) for k, a in enumerate(bad) for b in bad[k + 1 :])


def _mountings(T: FloatArray) -> Iterator[FloatArray]:
    """Other places of a camera, in optical axes."""
    rolls = [_turned_by(T, rpy_matrix(0.0, 0.0, math.radians(d))) for d in (180.0, 90.0, -90.0)]
    yaws = [_before(T, _about_z(d)) for d in (180.0, 90.0, -90.0)]
    yield from (*rolls, *yaws, _turned_by(T, OPTICAL_TO_BODY), _turned_by(T, OPTICAL_TO_BODY.T))
    yield np.asarray(np.linalg.inv(T))


def _turned_by(T: FloatArray, R: FloatArray) -> FloatArray:
    turned = T.copy()
    turned[:3, :3] = T[:3, :3] @ R
    return turned


def _before(T: FloatArray, R: FloatArray) -> FloatArray:
    turned = T.copy()
    turned[:3, :3] = R @ T[:3, :3]
    return turned


def _about_z(degrees: float) -> FloatArray:
    return rpy_matrix(0.0, 0.0, math.radians(degrees))


def _mounted(setup: Setup, T: FloatArray) -> Setup:
    return replace(setup, camera=replace(setup.camera, T_base_cam=T))


def _scaled(setup: Setup, factor: float) -> Setup:
    K = setup.camera.K.copy()
    K[:2] *= factor
    return replace(setup, camera=replace(setup.camera, K=K))


def _with(setup: Setup, **values: float) -> Setup:
    """The set-up with these values to start from; itself if they are its own."""
    extras = setup.extras.copy()
    for name, value in values.items():
        extras[EXTRAS.index(name)] = value
    return setup if np.array_equal(extras, setup.extras) else replace(setup, extras=extras)


def _set(config: Config, section: str, **values: Any) -> Config:
    part = getattr(config, section)
    return config.model_copy(update={section: part.model_copy(update=values)})


def _k1(setup: Setup) -> float:
    return float(setup.camera.D[0]) if len(setup.camera.D) else 0.0


def _angle(R: FloatArray) -> float:
    return math.acos(float(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0)))

