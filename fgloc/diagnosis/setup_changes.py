"""The gross mistakes that are looked for: what undoing each changes in a set-up, and what of it is to be found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fgloc.diagnosis.pose_text import OPTICAL_TO_BODY
from fgloc.diagnosis.setup_fit import Fit, Setup
from fgloc.diagnosis.setup_motion import EXTRAS
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

    @property
    def linearized(self) -> bool:
        """Whether the fit knows it to first order only."""
        return "camera.rx_rad" in self.free


def changes(setup: Setup, fit: Fit | None, source: str, has_gyro: bool) -> Iterator[Change]:
    """All that is tried on a set-up.

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
    K, D, T = (
        camera.K.copy(),
        np.concatenate([camera.D, np.zeros(4)])[: max(4, len(camera.D))],
        camera.T_base_cam.copy(),
    )
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


def k1_of(setup: Setup) -> float:
    """First coefficient of the camera's distortion."""
    return float(setup.camera.D[0]) if len(setup.camera.D) else 0.0


def angle_of(R: FloatArray) -> float:
    """Of a rotation ``(3, 3)`` [rad]."""
    return math.acos(float(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0)))
