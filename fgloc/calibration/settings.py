"""What a run has found of the installation as settings: the lines of ``robot.yaml`` and the map."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from operator import or_
from typing import Any

import numpy as np

from fgloc.assembly import Assembly
from fgloc.calibration.found import mounting
from fgloc.config import Config
from fgloc.frames import rotation_of
from fgloc.graph.installation import MARKER, Installation, InstallationEstimate
from fgloc.sensors import registry
from fgloc.sensors.cameras import pinhole
from fgloc.types import Camera, FloatArray, InstallationFound, LandmarkMap, Setting

_ODOMETER_ROLES = ("joints", "odometry", "command")  # whose messages may be taken for the wheels' motion
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_MOST_LOG_SCALE = 20.0  # of a run that diverged; larger ones overflow
_SIGMAS = {  # the field that takes the sigma of settings back; of several the largest
    "landmarks.range_scale": "landmarks.range_scale_sigma",
    "landmarks.bearing_bias_rad": "landmarks.bearing_bias_sigma_rad",
    "camera.focal_scale": "camera.focal_sigma",
    "camera.cx_px": "camera.principal_sigma_px",
    "camera.cy_px": "camera.principal_sigma_px",
    "camera.k1": "camera.distortion_sigma",
    "camera.k2": "camera.distortion_sigma",
}


def installation_found(parts: Assembly, roles: Container[str], belief: InstallationEstimate) -> InstallationFound:
    """What a run of these parts has found, from a recording with these roles."""
    installation, landmark_map, source = parts.localizer.factors.installation, parts.landmark_map, parts.wheels.source
    n = installation.constants  # height, roll and pitch of a pose are no installation
    found = InstallationFound(
        installation.names[:n],
        belief.mean[:n],
        belief.cov[:n, :n],
        installation.prior().cov[:n, :n],
        parts.camera,
        "image" if "image" in roles else "sightings",
        "joints" if source == "ticks" else source,
    )
    return replace(
        found,
        settings=settings_found(found, parts.config),
        landmarks=None if landmark_map is None else map_found(landmark_map, installation, belief),
    )


def settings_found(found: InstallationFound, config: Config) -> tuple[Setting, ...]:
    """Every setting that the state is about, but for the map's.

    Args:
        found: what was found.
        config: as the run used it.
    """
    state = _State(found)
    motion, sightings = _of_motion(state, config), _of_sightings(state, config)
    return (*motion, *sightings, *_of_camera(state, config, found.camera), *_clocks(state, config, found))


class _State:
    def __init__(self, found: InstallationFound) -> None:
        self.index = {name: i for i, name in enumerate(found.names)}
        self.mean, self.cov, self.prior = found.mean, found.cov, found.prior_cov

    def setting(self, name: str, given: float, found: float, gains: Mapping[str, float]) -> Iterator[Setting]:
        """One that depends on parameters of the state with these derivatives; none if it depends on none of them."""
        gains = {key: g for key, g in gains.items() if key in self.index}
        if gains:
            rows, g = [self.index[key] for key in gains], np.array(list(gains.values()))
            sigmas = [math.sqrt(g @ cov[np.ix_(rows, rows)] @ g) for cov in (self.cov, self.prior)]
            yield Setting(name, given, found, *sigmas)

    def value(self, name: str) -> float:
        return float(self.mean[self.index[name]]) if name in self.index else 0.0


def _of_motion(state: _State, config: Config) -> Iterator[Setting]:
    for installation in registry.motion_installations():
        yield from installation.settings(state, config)


def _of_sightings(state: _State, config: Config) -> Iterator[Setting]:
    scale, bias = config.landmarks.range_scale, config.landmarks.bearing_bias_rad
    found = scale * math.exp(min(state.value("sightings.range_scale"), _MOST_LOG_SCALE))
    yield from state.setting("landmarks.range_scale", scale, found, {"sightings.range_scale": scale})
    name = "sightings.bearing_offset_rad"
    yield from state.setting("landmarks.bearing_bias_rad", bias, bias + state.value(name), {name: 1.0})


def _of_camera(state: _State, config: Config, camera: Camera | None) -> Iterator[Setting]:
    if camera is None or "camera.x_m" not in state.index:
        return
    place = slice(state.index["camera.x_m"], state.index["camera.x_m"] + 6)
    at_first = mounting(camera, np.zeros(6), state.prior[place, place])
    now = mounting(camera, state.mean[place], state.cov[place, place])
    for axis in _AXES:
        (at, prior), (value, sigma) = at_first[f"camera.{axis}"], now[f"camera.{axis}"]
        yield Setting(f"camera.{axis}", at, value, sigma, prior)
    scale = config.camera.focal_scale
    found = scale * (1.0 + state.value("camera.focal"))
    yield from state.setting("camera.focal_scale", scale, found, {"camera.focal": scale})
    D = np.concatenate([camera.D, np.zeros(2)])
    given = {"cx_px": camera.K[0, 2], "cy_px": camera.K[1, 2]}
    if pinhole(camera) is camera:
        given |= {"k1": D[0], "k2": D[1]}
    for name, at in given.items():
        key = f"camera.{name}"
        yield from state.setting(key, float(at), float(at) + state.value(key), {key: 1.0})


def _clocks(state: _State, config: Config, found: InstallationFound) -> Iterator[Setting]:
    clocks = {"camera.time_offset_s": found.seen_by, "sightings.time_offset_s": found.seen_by}
    clocks[f"{registry.motion_names().odometer}.time_offset_s"] = found.wheels
    for name, role in clocks.items():
        if not role:
            continue
        given = {str(r): offset for r, offset in config.recording.stamp_offset_s.items()}.get(role, 0.0)
        yield from state.setting(f"stamp_offset_s.{role}", given, given - state.value(name), {name: -1.0})


def with_settings(config: Config, settings: Sequence[Setting]) -> Config:
    """The configuration with the values found and their sigmas; a sigma that was 0 stays so."""
    changes: dict[str, dict[str, Any]] = {}
    by_name = {s.name: s for s in settings}

    def put(key: str, value: Any) -> None:
        section, name = key.split(".")
        changes.setdefault(section, {})[name] = value

    def spread(key: str, sigma: float) -> None:
        section, name = key.split(".")
        if getattr(getattr(config, section), name) > 0.0:
            put(key, max(float(f"{sigma:.4g}"), changes.get(section, {}).get(name, 0.0)))

    sigmas = reduce(or_, (dict(made.sigmas) for made in registry.motion_installations()), _SIGMAS)
    for s in settings:
        if s.name in sigmas:
            put(s.name, round(s.found, 7))
            spread(sigmas[s.name], s.sigma / (s.given if "scale" in s.name else 1.0))
    if "camera.x" in by_name:
        pose = [by_name[f"camera.{axis}"] for axis in _AXES]
        put("recording.sightings_pose", tuple(round(s.found, 6) for s in pose))
        put("recording.sightings_axes", "optical")
        spread("camera.position_sigma_m", max(s.sigma for s in pose[:3]))
        spread("camera.rotation_sigma_rad", max(s.sigma for s in pose[3:]))
    clocks = {s.name.split(".")[1]: s for s in settings if s.name.startswith("stamp_offset_s.")}
    if clocks:
        put(
            "recording.stamp_offset_s",
            config.recording.stamp_offset_s | {r: round(s.found, 6) for r, s in clocks.items()},
        )
        for role, s in clocks.items():
            seen = "camera" if "camera.x" in by_name else "landmarks"
            section = registry.motion_names().odometer if role in _ODOMETER_ROLES else seen
            spread(f"{section}.time_offset_sigma_s", s.sigma)
    sections = {name: getattr(config, name).model_copy(update=values) for name, values in changes.items()}
    return config.model_copy(update=sections)


def map_found(landmark_map: LandmarkMap, installation: Installation, belief: InstallationEstimate) -> LandmarkMap:
    """The map with its landmarks where they were found, each with its covariance."""
    moved = dict(landmark_map.landmarks)
    for i, (first, count) in installation.landmarks.items():
        landmark, rows = moved[i], slice(first, first + count)
        mean, cov = belief.mean[rows], belief.cov[rows, rows]
        place = landmark.position.copy()
        place[: min(count, 3)] += mean[:3]
        turned = landmark.rotation @ rotation_of(mean[3:]) if count == len(MARKER) else landmark.rotation
        moved[i] = replace(landmark, position=place, rotation=turned, cov=_readable(cov))
    return replace(landmark_map, landmarks=moved, notes=())


def _readable(cov: FloatArray) -> FloatArray:
    """Of a marker the sigmas alone, which somebody can read."""
    return np.diag(np.diag(cov)) if len(cov) > 2 else 0.5 * (cov + cov.T)
