"""Gross mistakes of camera, map, wheels and clocks by markers in images, each with the line that undoes it.

A bounded excerpt of the recording is fitted with the set-up as given (`setup_fit`). Only where it does not fit as an
ordinary installation would, every mistake is undone in turn and fitted too: the one with which the cost falls to that
of a sound set-up is named. The likelihood ratio of the two set-ups is what makes it sure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fgloc.config import Config, Role, one_line, setting
from fgloc.diagnosis.comparison import unit_of
from fgloc.diagnosis.setup_fit import EXTRAS, Excerpt, Fit, Problem, Setup, Stretch, tells_place
from fgloc.frames import OPTICAL_TO_BODY, homogeneous, quaternion_matrix, rotation_of, rpy_matrix, sensor_pose
from fgloc.sensors.base import with_values
from fgloc.sensors.wheels.sensor import correct
from fgloc.types import Camera, Finding, FloatArray, Landmark, LandmarkMap, Severity

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
_MOST_SWAPS = 4  # of the worst markers, each with each
_SUSPECT = 3.0  # times the median squared residual of a marker


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One mistake undone.

    Attributes:
        kind: of the mistake.
        setup: with the mistake undone, where it is a definite one.
        free: prior sigmas of what it leaves to be found.
        has_gyro: whether delays against the gyro can be determined; of clocks.
    """

    kind: str
    setup: Setup
    free: Mapping[str, float] = field(default_factory=dict)
    has_gyro: bool = False


def changes(setup: Setup, fit: Fit | None, source: str, has_gyro: bool) -> Iterator[Change]:
    """All changes that are tried on a set-up.

    Args:
        setup: as given.
        fit: of it; None if there is none.
        source: of wheel motion: "ticks" or "odometry"; others are no evidence on wheels.
        has_gyro: whether clocks of wheels and camera can be distinguished.
    """
    yield Change("size", setup, {"size": _WIDE})
    yield Change("map_scale", setup, {"map_scale": _WIDE})
    yield Change("distortion", setup, {"camera.k1": _WIDE, "camera.k2": _WIDE})
    yield Change("focal", setup, {"camera.focal": _WIDE})
    for factor in (0.5, 2.0):
        K = setup.camera.K * np.array([[factor], [factor], [1.0]])
        yield Change("resolution", _with_camera(setup, K=K), {"camera.focal": 0.02})
    turned = {f"camera.r{axis}_rad": _WIDE for axis in "xyz"}
    yield Change("mounting", setup, turned)
    for T in _mountings(setup.camera.T_base_cam):
        yield Change("mounting", _with_camera(setup, T_base_cam=T), turned)
    yield Change("position", setup, {f"camera.{axis}_m": _WIDE for axis in "xyz"})
    yield Change("mirrored", replace(setup, landmark_map=mirrored(setup.landmark_map)))
    yield Change("quaternions", replace(setup, landmark_map=reordered(setup.landmark_map)))
    for a, b in _swaps(fit) if fit is not None else ():
        yield Change("ids", replace(setup, landmark_map=swapped(setup.landmark_map, a, b)))
    moving = source in ("ticks", "odometry")
    for start in (0.0, 0.6, -0.6):
        both = {"late_s": 1.0, "gyro_late_s": 1.0}
        yield Change("image_clock", _with(setup, late_s=start, gyro_late_s=start), both, has_gyro)
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
    if source == "ticks" and (track := setup.config.wheels.track) is not None:
        for kind, sign in (("left_reversed", 1.0), ("right_reversed", -1.0)):  # what is told as a way is a turn
            turned_by = np.array([[0.0, 0.0, 0.5 * track], [0.0, 1.0, 0.0], [2.0 / track, 0.0, 0.0]])
            yield Change(kind, replace(setup, turned=sign * turned_by))
    if source == "odometry":
        yield from (Change("odometry_frame", replace(setup, turned=_about_z(d))) for d in (90.0, -90.0, 180.0))


# --- taking in what was found ---


def refined(change: Change, fit: Fit) -> Change:
    """Change whose set-up includes the fitted values: the next fit starts there."""
    values = {name: value for name, (value, _) in fit.values.items()}
    setup = _with(change.setup, **{name: values[name] for name in change.free if name in EXTRAS})
    camera = setup.camera
    K, T = camera.K.copy(), camera.T_base_cam.copy()
    D = np.concatenate([camera.D, np.zeros(4)])[: max(4, len(camera.D))]
    if "camera.focal" in change.free:
        K[[0, 1], [0, 1]] *= 1.0 + values["camera.focal"]
    if "camera.k1" in change.free:
        D[:2] += values["camera.k1"], values["camera.k2"]
    if "camera.rx_rad" in change.free:
        T[:3, :3] = T[:3, :3] @ rotation_of(np.array([values[f"camera.r{axis}_rad"] for axis in "xyz"]))
    if "camera.x_m" in change.free:
        T[:3, 3] += T[:3, :3] @ np.array([values[f"camera.{axis}_m"] for axis in "xyz"])
    return replace(change, setup=_with_camera(setup, K=K, D=D, T_base_cam=T))


def gross(change: Change, given: Setup) -> bool:
    """Whether a change that was found is more than an ordinary installation's error."""
    setup, kind, values = change.setup, change.kind, change.setup.values
    if kind in ("size", "map_scale", "radius", "track"):
        return bool(abs(values[kind]) > _LEAST[kind])
    if kind == "image_clock" and change.has_gyro and abs(values["late_s"] - values["gyro_late_s"]) > _LEAST["late"]:
        return False  # then it is wheels or gyro that are late
    if kind.endswith("_clock"):
        return bool(abs(values["gyro_late_s" if kind == "gyro_clock" else "late_s"]) > _LEAST["late"])
    if kind in ("focal", "resolution"):
        return bool(abs(setup.camera.K[0, 0] / given.camera.K[0, 0] - 1.0) > _LEAST["camera.focal"])
    if kind == "distortion":
        return abs(k1_of(setup) - k1_of(given)) > _LEAST["camera.k1"]
    if kind == "mounting":
        return angle_of(given.camera.T_base_cam[:3, :3].T @ setup.camera.T_base_cam[:3, :3]) > _LEAST["rotation"]
    if kind == "position":
        moved = setup.camera.T_base_cam[:3, 3] - given.camera.T_base_cam[:3, 3]
        return float(np.linalg.norm(moved)) > _LEAST["position"]
    return True


# --- changes ---


def mirrored(landmark_map: LandmarkMap) -> LandmarkMap:
    """The map with the sign of y changed; markers keep upright."""
    flip = np.diag([1.0, -1.0, 1.0])
    across = np.diag([-1.0, 1.0, 1.0])
    known = {
        i: replace(m, position=flip @ m.position, rotation=flip @ m.rotation @ across, cov=None, board=None)
        for i, m in landmark_map.landmarks.items()
    }
    return replace(landmark_map, landmarks=known)


def by_places(finding: Finding, landmark_map: LandmarkMap) -> tuple[Finding, LandmarkMap] | None:
    """The map without the mistake that a comparison of marker's places names, and the finding as a map has it.

    Places of markers by an image are in the unit of the map's sizes: "sightings.scale" is a wrong size, and a scale of
    the wheels that is a unit's is that of the whole map.

    Args:
        finding: of `fgloc.diagnosis.conventions`, on markers' places in the camera's axes.
        landmark_map: as given.

    Returns:
        None: the finding is on something else.
    """
    value = finding.value
    unit = None if value is None else unit_of(value)
    factor = unit[0] if unit is not None else value or 1.0
    if finding.code == "map.mirrored":
        return finding, mirrored(landmark_map)
    if finding.code == "map.ids" and value is not None:
        moved = {i - round(value): m for i, m in landmark_map.landmarks.items()}
        changed = {i: replace(m, landmark_id=i) for i, m in moved.items() if i >= 0}
        return (finding, replace(landmark_map, landmarks=changed)) if changed else None
    if finding.code == "map.unit":
        return finding, scaled(landmark_map, positions=factor)
    if finding.code == "sightings.scale":
        text = (
            f"The markers' sizes are {1.0 / factor:.4g} times those that wheels and map agree on: correct them there."
        )
        return replace(finding, code="map.size", text=text, lines={}), scaled(landmark_map, sizes=factor)
    if finding.code == "wheels.scale" and unit is not None:
        factor = 1.0 / factor
        lines = shown("map", {"scale": factor, "size_scale": factor})
        text = (
            f"Positions and sizes on the map are {1.0 / factor:.4g} times what the wheels show: they are in another "
            f"unit, or the wheels' are; if it is the map, set {' and '.join(f'{k}: {v}' for k, v in lines.items())}."
        )
        finding = replace(finding, code="map.unit", text=text, lines=lines, value=factor)
        return finding, scaled(landmark_map, positions=factor, sizes=factor)
    return None


def scaled(landmark_map: LandmarkMap, positions: float = 1.0, sizes: float = 1.0) -> LandmarkMap:
    """The map with its positions and its markers' sizes so many times as large."""
    known = {
        i: replace(m, position=positions * m.position, size_m=sizes * m.size_m)
        for i, m in landmark_map.landmarks.items()
    }
    return replace(landmark_map, landmarks=known)


def reordered(landmark_map: LandmarkMap) -> LandmarkMap:
    """The map with its quaternions read as w, x, y, z instead of x, y, z, w."""
    known = {}
    for i, m in landmark_map.landmarks.items():
        w, x, y, z = Rotation.from_matrix(m.rotation).as_quat().tolist()
        known[i] = replace(m, rotation=quaternion_matrix((x, y, z, w)))
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
    R = T[:3, :3]
    quarters = [_about_z(degrees) for degrees in (180.0, 90.0, -90.0)]
    rolls, yaws = [R @ quarter for quarter in quarters], [quarter @ R for quarter in quarters]
    for turned in (*rolls, *yaws, R @ OPTICAL_TO_BODY, R @ OPTICAL_TO_BODY.T):
        yield homogeneous(turned, T[:3, 3])
    yield np.asarray(np.linalg.inv(T))


def _about_z(degrees: float) -> FloatArray:
    return rpy_matrix(0.0, 0.0, math.radians(degrees))


def _with_camera(setup: Setup, **values: FloatArray) -> Setup:
    return replace(setup, camera=replace(setup.camera, **values))  # type: ignore[arg-type]


def _with(setup: Setup, **values: float) -> Setup:
    """Set-up that starts from these values; the same object if they are its own."""
    extras = setup.extras.copy()
    for name, value in values.items():
        extras[EXTRAS.index(name)] = value
    return setup if np.array_equal(extras, setup.extras) else replace(setup, extras=extras)


def k1_of(setup: Setup) -> float:
    """First coefficient of the camera's distortion."""
    return float(setup.camera.D[0]) if len(setup.camera.D) else 0.0


def angle_of(R: FloatArray) -> float:
    """Angle [rad] of a rotation matrix ``(3, 3)``."""
    return math.acos(float(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0)))


# --- The sentence for each, and the settings with its line ------------------------------------------------------------

_SAID_DEG = 1.0  # degrees: less is not put into words
_LEVEL = 0.2  # horizontal part of a viewing axis: less looks straight up or down and has no roll
_ABOUT_DEG = 20.0  # degrees within which a camera counts as upside down, or as looking backward


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Finding that names the mistake with the lines to be set, and the settings and the map with the mistake undone."""

    finding: Finding
    config: Config
    landmark_map: LandmarkMap


def correction(change: Change, given: Setup, source: str, image: Role, wheels: Role) -> Correction:
    """The finding for a change, and the settings with it.

    Args:
        change: that was found.
        given: the set-up.
        source: of wheel motion.
        image: role whose stamps the sightings have.
        wheels: likewise of the wheels.
    """
    values = change.setup.values
    match change.kind:
        case "size":
            return _size(given, math.exp(values["size"]))
        case "map_scale":
            return _map_scale(given, math.exp(values["map_scale"]))
        case "mirrored" | "quaternions" | "ids":
            return _map(change, given)
        case "focal" | "resolution" | "distortion":
            return _lens(change, given)
        case "mounting" | "position":
            return _mounting(change, given)
        case "image_clock":
            return _clock(given, image, "images" if image == "image" else "sightings", values["late_s"])
        case "wheel_clock":
            return _clock(given, wheels, "wheels", -values["late_s"])
        case "gyro_clock":
            return _clock(given, "imu", "gyro", -values["gyro_late_s"])
        case _:
            return _odometer(change, given, source)


def _size(given: Setup, factor: float) -> Correction:
    sizes = sorted({m.size_m for m in given.landmark_map.landmarks.values() if m.size_m > 0.0})
    shown, line = f"{sizes[0]:.4g} to {sizes[-1]:.4g} m", f"multiply every size by {factor:.4f}"
    if len(sizes) == 1:
        shown, line = f"{sizes[0]:.4g} m", f"set size: {sizes[0] * factor:.4g} for every marker"
    text = (
        f"The markers' size is {shown} by the map, and {factor:.3f} times that by their places and the images: "
        f"{line} in the map."
    )
    finding = Finding("map.size", text, Severity.ERROR, value=factor)
    return Correction(finding, given.config, scaled(given.landmark_map, sizes=factor))


def _map_scale(given: Setup, factor: float) -> Correction:
    scale = given.config.map.scale * factor
    text = (
        f"Distances on the map are {1.0 / factor:.4g} times those that wheels and markers show: the map's scale is "
        f"wrong; multiply its positions by {factor:.5g}, or set {setting('map.scale')}: {scale:.5g}."
    )
    finding = Finding("map.unit", text, Severity.ERROR, shown("map", {"scale": round(scale, 6)}), factor)
    return Correction(finding, given.config, scaled(given.landmark_map, positions=factor))


_OF_MAP = {
    "mirrored": (
        "The map is mirrored against what wheels and camera show: change the sign of the y of all its positions "
        "(and of its markers' directions)."
    ),
    "quaternions": (
        "The map's quaternions are in the order w, x, y, z: so the markers face the way that the camera sees them; "
        "write them as x, y, z, w."
    ),
    "ids": "The map has ids {0} and {1} in each other's place: exchange ids {0} and {1} in the map.",
}


def _map(change: Change, given: Setup) -> Correction:
    before, after = given.landmark_map.landmarks, change.setup.landmark_map.landmarks
    moved = sorted(i for i in before if not np.array_equal(before[i].position, after[i].position))
    finding = Finding(f"map.{change.kind}", _OF_MAP[change.kind].format(*moved), Severity.ERROR)
    return Correction(finding, given.config, change.setup.landmark_map)


def _lens(change: Change, given: Setup) -> Correction:
    before, after = given.camera, change.setup.camera
    if change.kind == "distortion":
        k1, k2 = after.D[:2].tolist()
        sentence = (
            f"The camera's distortion is not as given, k1 {k1_of(given):.3g}: by the markers it is about {k1:.3g}; set "
            f"expert.camera.k1: {k1:.3f} and expert.camera.k2: {k2:.3f}, or better calibrate it."
        )
        return _set(given, "camera.distortion", sentence, "camera", {"k1": round(k1, 3), "k2": round(k2, 3)})
    factor = float(after.K[0, 0] / before.K[0, 0])
    scale = given.config.camera.focal_scale * factor
    line, what = f"set expert.camera.focal_scale: {scale:.4f}", "has the wrong focal length"
    values: dict[str, float] = {"focal_scale": scale}
    if change.kind == "resolution":
        values |= {"cx_px": float(after.K[0, 2]), "cy_px": float(after.K[1, 2])}
        line += f", expert.camera.cx_px: {after.K[0, 2]:.1f} and expert.camera.cy_px: {after.K[1, 2]:.1f}"
        what = "is for another resolution"
    sentence = (
        f"The camera's calibration {what}: {before.K[0, 0]:.1f} px given, {after.K[0, 0]:.1f} px seen; {line}, or "
        "better calibrate it."
    )
    return _set(given, f"camera.{change.kind}", sentence, "camera", values, factor)


def _mounting(change: Change, given: Setup) -> Correction:
    before, after = given.camera.T_base_cam, change.setup.camera.T_base_cam
    pose = sensor_pose(after, optical=True)
    values = {"sightings_pose": pose, "sightings_axes": "optical"}
    shown = ", ".join(f"{round(v, 4) + 0.0:g}" for v in pose)
    line = f"correct the transform, or set recording.sightings_pose: [{shown}]"
    if change.kind == "position":
        x, y, z = before[:3, :3].T @ (after[:3, 3] - before[:3, 3])
        sentence = f"The camera sits {z:+.2f} m ahead, {x:+.2f} m right, {y:+.2f} m below its transform: {line}."
    else:
        sentence = f"The camera {_turned(before, after)}: {line}."
    return _set(given, "sightings.mounting", sentence, "recording", values)


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
    """Roll [rad] of an optical frame ``T (4, 4)`` about its viewing axis; 0 if its x axis is level."""
    return math.atan2(-T[2, 0], -T[2, 1])


def _clock(given: Setup, role: Role, name: str, late_s: float) -> Correction:
    offsets = dict(given.config.recording.stamp_offset_s)
    offset = offsets.get(role, 0.0) - late_s
    side = "late" if late_s > 0 else "early"
    sentence = (
        f"The stamps of the {name} are {abs(late_s):.3f} s {side} against the others: set recording.stamp_offset_s: "
        f"{{{role}: {offset:.3f}}}."
    )
    values = {"stamp_offset_s": offsets | {role: offset}}
    return _set(given, f"clock.{role}", sentence, "recording", values, late_s)


def _odometer(change: Change, given: Setup, source: str) -> Correction:
    factor = math.exp(change.setup.values.get(change.kind, 0.0))
    found = correct(change.kind, factor, change.setup.turned, source == "ticks", given.config.wheels)
    value = factor if change.kind in ("radius", "track") else None
    return _set(given, found.code, found.sentence, found.section, found.values, value)


def _set(
    given: Setup, code: str, text: str, section: str, values: Mapping[str, Any], value: float | None = None
) -> Correction:
    """Correction by settings of one section alone."""
    finding = Finding(code, text, Severity.ERROR, shown(section, values), value)
    return Correction(finding, with_values(given.config, section, values), given.landmark_map)


def shown(section: str, values: Mapping[str, Any]) -> dict[str, str]:
    """Lines of a finding: ``section.key`` of robot.yaml to the value as YAML."""
    return {setting(f"{section}.{key}"): one_line(value) for key, value in values.items()}


# --- The check --------------------------------------------------------------------------------------------------------

_SURE = 15.0  # log-likelihood ratio of a mistake: some five sigmas
_STRAINED = 3.0  # sigmas of the prior: a parameter further off may stand in for a mistake
_MOTION_DOF = 4.0  # of each pair of images: wheels 3, gyro 1
_POOR = 3.0  # times the expected cost: a fit that is worse hides a mistake that is no small deviation
_EXPLAINED = 0.9  # share of the cost above the expected that a mistake explains where the motion stays noisy
_SEEN_RIGHT = 4.0  # median squared residual of the markers above which the poses are not to be compared with anything
_FEWEST = 20  # sightings
_FIRST_LOOK, _FINALISTS = 3, 3  # iterations with every change; changes that are fitted to the end
_LOOKED_AT = 2  # stretches that every change is first tried on
_REFINED = 3  # times that what was found is taken in and fitted again
_RISE = 0.15  # share of what is gained by which the costs of single stretches may rise: slipping wheels do not last
_SAME = 0.5  # cost by which a further fit has to be better


@dataclass(frozen=True, slots=True, eq=False)
class Checked:
    """Result of `check_fit`.

    Attributes:
        fit: of the set-up as given; None where nothing could be fitted.
        correction: of the mistake; None if there is none, or none that is sure.
        corrected: the fit without the mistake, or `fit`; None where neither determines the poses.
        stretches: that were fitted.
        unexplained: whether the sightings fit the map nowhere, and no mistake explains it.
        poor: whether wheels and sightings contradict each other, and no mistake explains it.
    """

    fit: Fit | None
    correction: Correction | None
    corrected: Fit | None
    stretches: Sequence[Stretch]
    unexplained: bool = False
    poor: bool = False


def check_fit(
    excerpt: Excerpt,
    config: Config,
    landmark_map: LandmarkMap,
    camera: Camera,
    imu_up: FloatArray | None,
    image: Role,
) -> Checked:
    """Fit an excerpt with the set-up as given and, where that does not fit, with each mistake undone.

    Args:
        excerpt: of the recording.
        config: as given; ``excerpt`` was read with it.
        landmark_map: as given.
        camera: as given.
        imu_up: ``(3,)`` the base's z axis in the IMU's frame; None: there is no gyro.
        image: role whose stamps the sightings have.
    """
    stretches = [s for s in excerpt.stretches(config, imu_up) if tells_place(s, landmark_map)]
    setup = Setup(config, landmark_map, camera)
    problem = Problem(stretches, setup, {}) if stretches else None
    if problem is None or problem.sightings < _FEWEST:
        return Checked(None, None, None, stretches)
    fit = problem.solve()
    expected = 0.5 * _MOTION_DOF * problem.pairs
    poor = fit is None or fit.cost > _POOR * expected
    if fit is not None and not poor and not _strained(fit):
        return Checked(fit, None, fit, stretches)
    has_gyro = any(s.gyro is not None for s in stretches)
    tried = list(changes(setup, fit, excerpt.wheel_source, has_gyro))
    last = _small(tried, setup, fit) if fit is not None else []
    if fit is None or poor:
        last = [*last[:1], *[c for c in _looked_at(tried, stretches) if c not in last[:1]][:_FINALISTS]]
    starts = None if fit is None or poor else fit.poses
    ended = [e for e in (_ended(change, stretches, starts) for change in last) if e is not None]
    sure = [e for e in ended if gross(e[0], setup) and _explains(fit, e[1], expected)]
    if not sure:
        seen_right = fit is not None and fit.misfit < _SEEN_RIGHT
        return Checked(fit, None, fit if seen_right else None, stretches, not seen_right, fit is None or poor)
    change, better = min(sure, key=lambda e: e[1].cost)
    wheels: Role = "joints" if excerpt.wheel_source == "ticks" else "odometry"
    sentence = correction(change, setup, excerpt.wheel_source, image, wheels)
    return Checked(fit, sentence, better, stretches)


def _small(tried: Iterable[Change], setup: Setup, fit: Fit) -> list[Change]:
    """Small deviations among the changes, those first that would lower the cost of a fit the most."""
    small = [change for change in tried if change.setup is setup]
    return sorted(small, key=lambda change: -fit.gain(change.free))[:_FINALISTS]


def _looked_at(tried: Iterable[Change], stretches: Sequence[Stretch]) -> list[Change]:
    """Changes in the order of their costs on the stretches with the most motion."""
    most = sorted(stretches, key=lambda s: -float(np.abs(s.wheels).sum()))[:_LOOKED_AT]
    some = [replace(s, times=s.times[::2], pictures=s.pictures[::2]) for s in most]
    looks = [(Problem(some, change.setup, change.free).solve(iterations=_FIRST_LOOK), change) for change in tried]
    looks.sort(key=lambda look: math.inf if look[0] is None else look[0].cost)
    return [change for _, change in looks]


def _ended(change: Change, stretches: Sequence[Stretch], poses: FloatArray | None) -> tuple[Change, Fit] | None:
    """Change and fit after convergence; with angles, the solution is applied to the set-up and fitted again."""
    last: Fit | None = None
    for _ in range(_REFINED):
        fit = Problem(stretches, change.setup, change.free).solve(poses)
        if fit is None:
            break
        change, poses = refined(change, fit), fit.poses
        done = last is not None and fit.cost > last.cost - _SAME
        last = fit
        if done or "camera.rx_rad" not in change.free:  # the fit is linear in the camera's angles
            break
    return None if last is None else (change, last)


def _strained(fit: Fit) -> bool:
    """Whether a parameter other than a marker's place is far from what was given."""
    return any(abs(v) > _STRAINED * s for name, (v, s) in fit.values.items() if not name.startswith("map."))


def _explains(fit: Fit | None, better: Fit, expected: float) -> bool:
    """Whether a change surely makes a sound set-up, and so throughout the excerpt."""
    sound = better.cost < _POOR * expected
    if fit is None:
        return sound
    if not sound and fit.cost - better.cost < _EXPLAINED * (fit.cost - expected):
        return False
    gained, risen = fit.cost - better.cost, float(np.maximum(better.costs - fit.costs, 0.0).sum())
    return gained > _SURE and risen < _RISE * gained
