"""Installation estimated by a run: values, settings with their lines, and given values that it contradicts.

A careful installation is off by its prior sigmas, and finding that is what the state is for: it is no reason to write.
Reported is what the measurements alone have further off than three sigmas of the two together (`Setting.off`), and
what was found further off than three of its own: of 20 parameters of a careful installation one in every 19 runs.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from operator import or_
from typing import Any

import numpy as np

from fgloc.assembly import Assembly
from fgloc.config import CAMERA_ROLES, Config, camera_role, one_line, setting
from fgloc.frames import rotation_of, sensor_pose
from fgloc.graph.contradictions import Contradiction
from fgloc.graph.installation import MARKER, Installation, InstallationEstimate, camera_block
from fgloc.sensors import odometry, registry
from fgloc.sensors.base import FoundRow, InstallationState
from fgloc.sensors.cameras import pinhole
from fgloc.sensors.wheels.motion import DRIVE
from fgloc.stats import PRIOR_GATE, ROUNDING, SURE_SIGMAS, rounded
from fgloc.types import Camera, Finding, FloatArray, InstallationFound, LandmarkMap, Setting, Severity, note

Found = Mapping[str, tuple[float, float]]
"""Value and sigma by name."""

_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_ONE_ANGLE = 0.1  # cosine of a camera's pitch below which roll and yaw are nearly one angle (it looks up or down)
_OF_SIGHTINGS = {"range_scale": 1.0, "bearing_offset_rad": 0.0, "time_offset_s": 0.0, "x_m": 0.0, "y_m": 0.0}  # at 0


def found_values(
    installation: Installation,
    belief: InstallationEstimate,
    config: Config,
    cameras: Sequence[Camera],
    landmark_map: LandmarkMap | None,
) -> Found:
    """Values with their sigmas, by name.

    - ``wheels.radius_scale``, ``.track_scale``, ``gyro.scale`` (reported over true), ``learned.scale`` and other gains;
      ``wheels.radius_ratio``: left over right, where the track is known, else ``wheels.yaw_per_m`` [rad/m];
    - ``camera.time_offset_s``, ``wheels.time_offset_s``, ``sightings.time_offset_s``: how much later than the gyro's
      (without a gyro: the wheels') their stamps are; ``sightings.range_scale``, ``.bearing_offset_rad``;
    - ``camera.x``, ``.y``, ``.z`` [m], ``.roll``, ``.pitch``, ``.yaw`` [rad]: of its body axes in the base frame;
      ``camera.focal_scale``, ``.cx_px``, ``.cy_px``, ``.k1``, ``.k2``;
      of several cameras ``cameras.front.x`` and so on;
    - ``map.7.x``, ``.y``, ``.z`` [m]: of landmark 7.
    """
    motion = [row for made in registry.MOTION_INSTALLATIONS for row in made.found(config)]
    sightings = [FoundRow(f"sightings.{name}", f"sightings.{name}", at, 1.0) for name, at in _OF_SIGHTINGS.items()]
    out = _values([*motion, *registry.found_rows(config), *sightings], installation, belief)
    for camera in cameras:
        if (block := camera_block(camera.name)) in installation.blocks:
            first = installation.blocks[block][0]
            place = slice(first, first + 6)
            out |= mounting(camera, belief.mean[place], belief.cov[place, place])
            out |= _values(_lens_rows(camera), installation, belief)
    for i in installation.landmarks if landmark_map is not None else ():
        at = landmark_map.landmarks[i].position.tolist()  # type: ignore[union-attr]
        rows = [FoundRow(f"map.{i}.{a}", f"map.{i}.{a}_m", value, 1.0) for a, value in zip("xyz", at, strict=True)]
        out |= _values(rows, installation, belief)
    return out


def _values(
    rows: Iterable[FoundRow], installation: Installation, belief: InstallationEstimate
) -> dict[str, tuple[float, float]]:
    """Value and sigma of those rows whose parameter is estimated."""
    sigma = np.sqrt(np.diag(belief.cov))
    out = {}
    for name, parameter, at, gain in rows:
        if parameter in installation.index:
            i = installation.index[parameter]
            out[name] = (at + gain * float(belief.mean[i]), abs(gain) * float(sigma[i]))
    return out


def _lens_rows(camera: Camera) -> list[FoundRow]:
    k1, k2 = np.concatenate([camera.D, np.zeros(2)])[:2]
    rows = [
        ("focal_scale", "focal", 1.0),
        ("cx_px", "cx_px", float(camera.K[0, 2])),
        ("cy_px", "cy_px", float(camera.K[1, 2])),
        ("k1", "k1", float(k1)),
        ("k2", "k2", float(k2)),
        ("time_offset_s", "time_offset_s", 0.0),
    ]
    block = camera_block(camera.name)
    return [FoundRow(f"{block}.{name}", f"{block}.{parameter}", at, 1.0) for name, parameter, at in rows]


def mounting(camera: Camera, mean: FloatArray, cov: FloatArray) -> Found:
    """Pose of the camera's body axes in the base frame; angles are small, so that sigmas are those about its axes."""
    R = camera.T_base_cam[:3, :3]
    moved = camera.T_base_cam.copy()
    moved[:3, :3], moved[:3, 3] = R @ rotation_of(mean[3:]), moved[:3, 3] + R @ mean[:3]
    to_base = np.kron(np.eye(2), R)
    sigmas = np.sqrt(np.diag(to_base @ cov @ to_base.T))
    return {
        f"{camera_block(camera.name)}.{axis}": (float(value), float(s))
        for axis, value, s in zip(_AXES, sensor_pose(moved, optical=True), sigmas, strict=True)
    }


# --- Settings: lines of robot.yaml and the map ------------------------------------------------------------------------

_ODOMETER_ROLES = ("joints", "odometry", "command")  # whose messages may be taken for the wheels' motion
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


def installation_found(
    parts: Assembly, roles: Container[str], installation: Installation, belief: InstallationEstimate
) -> InstallationFound:
    """Installation estimated by a run of these parts, for a recording with these roles."""
    landmark_map, source = parts.landmark_map, parts.wheels.source
    n = installation.constants  # height, roll and pitch of a pose are no installation
    found = InstallationFound(
        installation.names[:n],
        belief.mean[:n],
        belief.cov[:n, :n],
        installation.prior().cov[:n, :n],
        parts.cameras,
        _seen_by(parts, roles),
        "joints" if source == "ticks" else source,
    )
    return replace(
        found,
        settings=settings_found(found, parts.config),
        landmarks=None if landmark_map is None else map_found(landmark_map, installation, belief),
    )


def _seen_by(parts: Assembly, roles: Container[str]) -> str:
    """Role whose stamps the sightings have; "" where registered sensors alone see landmarks."""
    if "image" in roles:
        return "image"
    return "sightings" if parts.cameras or "sightings" in roles or not parts.sensors else ""


def settings_found(found: InstallationFound, config: Config) -> tuple[Setting, ...]:
    """Every setting that the state is about, but for the map's.

    Args:
        found: what was found.
        config: as the run used it.
    """
    state = InstallationState(found)
    motion = (s for made in registry.MOTION_INSTALLATIONS for s in made.settings(state, config))
    of_cameras = (s for camera in found.cameras for s in _of_camera(state, config, camera))
    return (*motion, *_of_sightings(state, config), *of_cameras, *_clocks(state, config, found))


def constants_found(found: InstallationFound, config: Config) -> Iterator[Setting]:
    """Constants of odometries beside the wheels and of registered sensors, which no line of ``robot.yaml`` takes back.

    Args:
        found: what was found.
        config: as the run used it.
    """
    state = InstallationState(found)
    for row in (*odometry.INSTALLATION.found(config), *registry.found_rows(config)):
        yield from state.setting(
            row.name, row.at, row.at + row.gain * state.value(row.parameter), {row.parameter: row.gain}
        )


def _of_sightings(state: InstallationState, config: Config) -> Iterator[Setting]:
    scale, bias = config.landmarks.range_scale, config.landmarks.bearing_bias_rad
    found = scale * math.exp(min(state.value("sightings.range_scale"), _MOST_LOG_SCALE))
    yield from state.setting("landmarks.range_scale", scale, found, {"sightings.range_scale": scale})
    name = "sightings.bearing_offset_rad"
    yield from state.setting("landmarks.bearing_bias_rad", bias, bias + state.value(name), {name: 1.0})


def _of_camera(state: InstallationState, config: Config, camera: Camera) -> Iterator[Setting]:
    block = camera_block(camera.name)
    if f"{block}.x_m" not in state.index:
        return
    first = state.index[f"{block}.x_m"]
    place = slice(first, first + 6)
    at_first = mounting(camera, np.zeros(6), state.prior[place, place])
    now = mounting(camera, state.mean[place], state.cov[place, place])
    turned = camera.T_base_cam[:3, :3] @ state.mean[place][3:]  # about the base's axes
    for k, axis in enumerate(_AXES):
        (at, prior), (value, sigma) = at_first[f"{block}.{axis}"], now[f"{block}.{axis}"]
        if k > 2 and math.cos(now[f"{block}.pitch"][0]) < _ONE_ANGLE:
            at = value - turned[k - 3]  # the given rotation, by angles as near those found as it has
        yield Setting(f"{block}.{axis}", at, value, sigma, prior)
    scale = config.of_camera(camera.name).camera.focal_scale
    found = scale * (1.0 + state.value(f"{block}.focal"))
    yield from state.setting(f"{block}.focal_scale", scale, found, {f"{block}.focal": scale})
    D = np.concatenate([camera.D, np.zeros(2)])
    given = {"cx_px": camera.K[0, 2], "cy_px": camera.K[1, 2]}
    if pinhole(camera) is camera:
        given |= {"k1": D[0], "k2": D[1]}
    for name, at in given.items():
        key = f"{block}.{name}"
        yield from state.setting(key, float(at), float(at) + state.value(key), {key: 1.0})


def _clocks(state: InstallationState, config: Config, found: InstallationFound) -> Iterator[Setting]:
    clocks = {"camera.time_offset_s": found.seen_by, "sightings.time_offset_s": found.seen_by}
    for camera in found.cameras:
        if camera.name:
            clocks[f"{camera_block(camera.name)}.time_offset_s"] = camera_role(
                camera.name, "image" if config.cameras[camera.name].image is not None else "sightings"
            )
    clocks["wheels.time_offset_s"] = found.wheels
    for name, role in clocks.items():
        if not role:
            continue
        given = {str(r): offset for r, offset in config.recording.stamp_offset_s.items()}.get(role, 0.0)
        yield from state.setting(f"stamp_offset_s.{role}", given, given - state.value(name), {name: -1.0})


def _of_one(settings: Iterable[Setting], name: str) -> Iterator[Setting]:
    """Settings of one of several cameras, by their names in a configuration that has it alone."""
    block, roles = f"{camera_block(name)}.", {camera_role(name, role): role for role in CAMERA_ROLES}
    for s in settings:
        role = s.name.removeprefix("stamp_offset_s.")
        if s.name.startswith(block):
            yield replace(s, name=f"camera.{s.name.removeprefix(block)}")
        elif role in roles:
            yield replace(s, name=f"stamp_offset_s.{roles[role]}")


def with_settings(config: Config, settings: Sequence[Setting]) -> Config:
    """The configuration with the values found and their sigmas; a sigma that was 0 stays so."""
    for name in config.cameras:
        alone = with_settings(config.of_camera(name), list(_of_one(settings, name)))
        config = config.with_camera(name, alone)
    of_cameras = {camera_role(name, role) for name in config.cameras for role in CAMERA_ROLES}
    settings = [
        s
        for s in settings
        if not s.name.startswith("cameras.") and s.name.removeprefix("stamp_offset_s.") not in of_cameras
    ]
    changes: dict[str, dict[str, Any]] = {}
    by_name = {s.name: s for s in settings}

    def put(key: str, value: Any) -> None:
        section, _, name = key.partition(".")
        changes.setdefault(section, {})[name] = value

    def spread(key: str, sigma: float) -> None:
        section, _, name = key.partition(".")
        if getattr(getattr(config, section), name) > 0.0:
            put(key, max(float(f"{sigma:.4g}"), changes.get(section, {}).get(name, 0.0)))

    sigmas = reduce(or_, (dict(made.sigmas) for made in registry.MOTION_INSTALLATIONS), _SIGMAS)
    for s in settings:
        if s.name in sigmas:
            put(s.name, round(s.found, 7))
            if sigmas[s.name]:
                spread(sigmas[s.name], s.sigma / (s.given if "scale" in s.name else 1.0))
    of_drive = {s.name.removeprefix(DRIVE): s for s in settings if s.name.startswith(DRIVE)}
    if of_drive and config.wheels.drive is not None:
        values = {name: round(s.found, 9) for name, s in of_drive.items()}
        sigmas_found = {name: float(f"{s.sigma:.4g}") for name, s in of_drive.items()}
        put("wheels.drive", config.wheels.drive.with_values(values, sigmas_found))
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
            section = "wheels" if role in _ODOMETER_ROLES else seen
            spread(f"{section}.time_offset_sigma_s", s.sigma)
    sections = {name: getattr(config, name).model_copy(update=values) for name, values in changes.items()}
    return config.model_copy(update=sections)


def map_found(landmark_map: LandmarkMap, installation: Installation, belief: InstallationEstimate) -> LandmarkMap:
    """The map with its landmarks where they were found, each with its covariance, boards with that of their pose."""
    moved = dict(landmark_map.landmarks)
    for i, (first, count) in installation.landmarks.items():
        landmark, rows = moved[i], slice(first, first + count)
        mean, cov = belief.mean[rows], belief.cov[rows, rows]
        place = landmark.position.copy()
        place[: min(count, 3)] += mean[:3]
        turned = landmark.rotation @ rotation_of(mean[3:]) if count == len(MARKER) else landmark.rotation
        moved[i] = replace(landmark, position=place, rotation=turned, cov=_readable(cov))
    for ids, cov in installation.boards_found(belief):
        on = {i: board for i in ids if (board := moved[i].board) is not None}
        found = replace(on[ids[0]][0], cov=cov)
        moved |= {i: replace(moved[i], board=(found, lever)) for i, (_, lever) in on.items()}
    return replace(landmark_map, landmarks=moved, notes=())


def _readable(cov: FloatArray) -> FloatArray:
    """Covariance ``(n, n)`` as written to a map: of a marker its diagonal only, of a point the symmetric matrix."""
    return np.diag(np.diag(cov)) if len(cov) > 2 else 0.5 * (cov + cov.T)


# --- A setting as it is shown -----------------------------------------------------------------------------------------

_SUFFIXES = {"s": "s", "m": "m", "px": "px", "rad": "rad"}
_UNITS = dict.fromkeys(("x", "y", "z"), "m") | dict.fromkeys(("roll", "pitch", "yaw"), "rad")
_UNITS |= {"yaw_per_m": "rad/m", "slowdown": "s/rad", "steering_zero": "rad", "steering_zeros": "rad"}
_UNITS |= dict.fromkeys(("radius", "track", "wheelbase", "half_sum", "ring", "axle_x"), "m")


def setting_unit(name: str) -> str:
    """Unit of a setting such as ``camera.cx_px``; "-" for a ratio."""
    section, _, key = name.partition(".")
    key = key.rpartition(".")[2] if section == "cameras" else key
    named = section if section.startswith("stamp_offset") else key.removeprefix("drive.").rstrip("_0123456789")
    return _UNITS.get(named) or (_SUFFIXES.get(named.rpartition("_")[2], "-") if "_" in named else "-")


def given_text(s: Setting) -> str:
    """Given value of a setting, with as many digits as the estimated value has."""
    return rounded(s.given, s.sigma)[0]


def found_text(s: Setting) -> str:
    """Estimated value of a setting and its sigma."""
    return " ± ".join(rounded(s.found, s.sigma))


# --- Given values that the run contradicts ----------------------------------------------------------------------------

_SURE_2 = 11.8  # χ² of two degrees of freedom, as rare as three sigmas of one
CODES = ("installation.contradiction", "installation.off", "map.moved")
_WHEELS = ("joints", "odometry")  # a robot follows its commands late: that is no clock's fault
_LATE_S = 0.03  # less is within what drivers mean by a stamp
_MOST_NAMED = 5  # landmarks
_NOT_COMPARED = "; `fgloc smooth` compares what explains it."
_UNEXPLAINED = ". No constant alone explains it: look for a wrong axis, sign, unit or clock."


def contradictions(found: InstallationFound, config: Config) -> list[Finding]:
    """One finding for every given value that is contradicted, one for all landmarks.

    What was found is used, as it is within the gate of its prior; what is not: `contradiction_findings`.
    """
    off = [s for s in found.settings if contradicted(s)]
    findings = [
        Finding(
            CODES[1],
            f"{s.name} is {_number(s)}, {s.given:.6g} was given: set {_line(s)}.",
            Severity.WARNING,
            _lines([s]),
            s.found,
            s.sigma,
        )
        for s in off
        if not _is_clock(s)
    ]
    clocks = [s for s in off if _is_clock(s) and abs(s.unpulled) > _LATE_S] if found.wheels in _WHEELS else []
    return [*findings, *_late_clocks(clocks, config), *note(CODES[2], _landmarks(found), Severity.WARNING)]


def _late_clocks(off: Sequence[Setting], config: Config) -> Iterator[Finding]:
    """Clocks that are late or early; all of them to one side: the gyro's, which they are compared to."""
    all_given = {str(r): offset for r, offset in config.recording.stamp_offset_s.items()}
    late = {s.name.split(".")[1]: (s.given, -s.unpulled, s.sigma) for s in off}
    if len(off) > 1 and len({s.unpulled > 0.0 for s in off}) == 1:
        mean = sum(s.unpulled for s in off) / len(off)
        late = {"imu": (all_given.get("imu", 0.0), mean, max(s.sigma for s in off))}
    for role, (given, late_s, sigma) in late.items():
        line = one_line(all_given | {role: round(given - late_s, 3)})
        text = (
            f"The stamps of {role} are {abs(late_s):.3f} ± {sigma:.3f} s {'late' if late_s > 0.0 else 'early'} against "
            f"the others: set recording.stamp_offset_s: {line}, or correct the others."
        )
        lines = {"recording.stamp_offset_s": line}
        yield Finding(f"clock.{role}", text, Severity.WARNING, lines, late_s, sigma)


def contradiction_findings(
    found: InstallationFound, contradiction: Contradiction | None, config: Config
) -> list[Finding]:
    """The finding about constants that are beyond the gate of their prior, with what explains it; at most one.

    Args:
        found: the installation as it was used.
        contradiction: of the run.
        config: as the run used it.
    """
    if contradiction is None:
        return []
    settings, rivals = _settings(found, contradiction.names, config), contradiction.rivals
    names = _listed([s.name for s in settings] or contradiction.names)
    text = (
        f"The recording contradicts what was given of {names} by more than {PRIOR_GATE:g} sigmas, and it was not used"
    )
    if rivals is None:
        return [Finding(CODES[0], f"{text}{_NOT_COMPARED}", Severity.ERROR)]
    if not rivals:
        return [Finding(CODES[0], f"{text}{_UNEXPLAINED}", Severity.ERROR)]
    options = [_settings(found, rival.names, config, rival.mean, rival.sigmas) for rival in rivals]
    lines = _lines(options[0]) if len(rivals) == 1 and rivals[0].sensible else {}
    said = [[f"{s.name} {_number(s)}" for s in option] for option in options]
    shown = " or ".join(" with ".join(own or rival.names) for own, rival in zip(said, rivals, strict=True))
    if lines:
        told = f"{text}: {shown} explains it best. Set {', '.join(f'{key}: {value}' for key, value in lines.items())}."
    elif len(rivals) > 1:
        told = f"{text}: {shown} explain it alike, and the data cannot tell which."
    else:
        told = (
            f"{text}: {shown} would explain it, which is no installation. Look for a wrong axis, sign, unit or clock."
        )
    value = (options[0][0].found, options[0][0].sigma) if len(rivals) == 1 and options[0] else (None, None)
    return [Finding(CODES[0], told, Severity.ERROR, lines, *value)]


def _settings(
    found: InstallationFound,
    names: Sequence[str],
    config: Config,
    mean: FloatArray | None = None,
    sigmas: FloatArray | None = None,
) -> list[Setting]:
    """Settings that these constants alone change; without values, by one prior sigma each."""
    every = (*found.names, *(name for name in names if name not in found.names))
    rows, n = [every.index(name) for name in names], len(every)
    prior = np.eye(n)
    prior[: len(found.names), : len(found.names)] = found.prior_cov
    theta, cov = np.zeros(n), np.zeros((n, n))
    theta[rows] = np.sqrt(np.diag(prior)[rows]) if mean is None else mean
    cov[rows, rows] = 0.0 if sigmas is None else sigmas**2
    state = replace(found, names=every, mean=theta, cov=cov, prior_cov=prior)
    return [s for s in settings_found(state, config) if abs(s.found - s.given) > ROUNDING]


def _lines(settings: Sequence[Setting]) -> dict[str, str]:
    """Keys of ``robot.yaml`` with the values of these settings; the camera's pose is in the run's installation.yaml."""
    lines: dict[str, str] = {}
    for s in settings:
        section, _, key = s.name.partition(".")
        if section == "stamp_offset_s":
            lines["recording.stamp_offset_s"] = f"{{{key}: {s.found:.3f}}}"
        elif s.name.rpartition(".")[2] not in _AXES:
            lines[setting(s.name)] = f"{s.found:.5g}"
    return lines


def _listed(names: Iterable[str]) -> str:
    every = list(names)
    return " and ".join([", ".join(every[:-1]), every[-1]] if len(every) > 1 else every)


def contradicted(s: Setting) -> bool:
    """Whether what was found is surely further from what was given than that may be off."""
    return abs(s.off) > SURE_SIGMAS and abs(s.found - s.given) > SURE_SIGMAS * s.sigma


def _landmarks(found: InstallationFound) -> Iterator[str]:
    """Landmarks that stand elsewhere, in the plane."""
    index = {name: i for i, name in enumerate(found.names)}
    off: list[tuple[float, int]] = []
    for i in found.landmarks.landmarks if found.landmarks is not None else ():
        rows = [index[name] for name in (f"map.{i}.x_m", f"map.{i}.y_m") if name in index]
        if not rows:
            continue
        d = found.mean[rows]
        sizes = [float(d @ np.linalg.solve(cov[np.ix_(rows, rows)], d)) for cov in (found.cov, found.prior_cov)]
        if min(sizes) > _SURE_2:
            off.append((math.hypot(*d), i))
    if off:
        named = ", ".join(f"{i} ({1e3 * m:.0f} mm)" for m, i in sorted(off, reverse=True)[:_MOST_NAMED])
        more = f" and {len(off) - _MOST_NAMED} more" if len(off) > _MOST_NAMED else ""
        yield f"Landmarks do not stand where the map has them: {named}{more}; take the run's map.yaml or survey them."


def _is_clock(s: Setting) -> bool:
    return s.name.startswith("stamp_offset_s.")


def _line(s: Setting) -> str:
    block, _, key = s.name.rpartition(".")
    if key in _AXES:
        place = "recording.sightings_pose" if block == "camera" else f"{block}.pose"
        return f"{place}, as the run's installation.yaml has it"
    return f"{setting(s.name)}: {s.found:.5g}"


def _number(s: Setting) -> str:
    return f"{s.found:.5g} ± {s.sigma:.2g}"
