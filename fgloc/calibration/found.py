"""What a run has found of the installation, in the units and frames that a user gives it in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from fgloc.config import Config
from fgloc.frames import rotation_of
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.sensors import registry
from fgloc.types import Camera, FloatArray, LandmarkMap

Found = Mapping[str, tuple[float, float]]
"""Value and sigma by name."""

_Row = tuple[str, str, float, float]  # name, parameter of the installation, value at 0, change by the parameter
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical axes in body axes (REP 103)
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


def found_values(
    installation: Installation,
    belief: InstallationEstimate,
    config: Config,
    camera: Camera | None,
    landmark_map: LandmarkMap | None,
) -> Found:
    """Values with their sigmas, by name.

    - ``wheels.radius_scale``, ``.track_scale``, ``gyro.scale`` (reported over true), ``learned.scale``;
      ``wheels.radius_ratio``: left over right, where the track is known, else ``wheels.yaw_per_m`` [rad/m];
    - ``camera.time_offset_s``, ``wheels.time_offset_s``, ``sightings.time_offset_s``: how much later than the gyro's
      (without a gyro: the wheels') their stamps are; ``sightings.range_scale``, ``.bearing_offset_rad``;
    - ``camera.x``, ``.y``, ``.z`` [m], ``.roll``, ``.pitch``, ``.yaw`` [rad]: of its body axes in the base frame;
      ``camera.focal_scale``, ``.cx_px``, ``.cy_px``, ``.k1``, ``.k2``;
    - ``map.7.x``, ``.y``, ``.z`` [m]: of landmark 7.
    """
    motion = [row for made in registry.motion_installations() for row in made.found(config)]
    out = _values([*motion, *_sighting_rows()], installation, belief)
    if camera is not None and "camera" in installation.blocks:
        first = installation.blocks["camera"][0]
        out |= mounting(camera, belief.mean[first : first + 6], belief.cov[first : first + 6, first : first + 6])
        out |= _values(_lens_rows(camera), installation, belief)
    for i in installation.landmarks if landmark_map is not None else ():
        place = landmark_map.landmarks[i].position.tolist()  # type: ignore[union-attr]
        rows = [(f"map.{i}.{axis}", f"map.{i}.{axis}_m", at, 1.0) for axis, at in zip("xyz", place, strict=True)]
        out |= _values(rows, installation, belief)
    return out


def _values(
    rows: Iterable[_Row], installation: Installation, belief: InstallationEstimate
) -> dict[str, tuple[float, float]]:
    """Value and sigma of those rows whose parameter is estimated."""
    sigma = np.sqrt(np.diag(belief.cov))
    out = {}
    for name, parameter, at, gain in rows:
        if parameter in installation.index:
            i = installation.index[parameter]
            out[name] = (at + gain * float(belief.mean[i]), abs(gain) * float(sigma[i]))
    return out


def _sighting_rows() -> list[_Row]:
    return [
        ("sightings.range_scale", "sightings.range_scale", 1.0, 1.0),
        ("sightings.bearing_offset_rad", "sightings.bearing_offset_rad", 0.0, 1.0),
        ("sightings.time_offset_s", "sightings.time_offset_s", 0.0, 1.0),
    ]


def _lens_rows(camera: Camera) -> list[_Row]:
    k1, k2 = np.concatenate([camera.D, np.zeros(2)])[:2]
    return [
        ("camera.focal_scale", "camera.focal", 1.0, 1.0),
        ("camera.cx_px", "camera.cx_px", float(camera.K[0, 2]), 1.0),
        ("camera.cy_px", "camera.cy_px", float(camera.K[1, 2]), 1.0),
        ("camera.k1", "camera.k1", float(k1), 1.0),
        ("camera.k2", "camera.k2", float(k2), 1.0),
        ("camera.time_offset_s", "camera.time_offset_s", 0.0, 1.0),
    ]


def mounting(camera: Camera, mean: FloatArray, cov: FloatArray) -> Found:
    """Pose of the camera's body axes in the base frame; angles are small, so that sigmas are those about its axes."""
    R = camera.T_base_cam[:3, :3]
    T = camera.T_base_cam[:3, 3] + R @ mean[:3]
    turned = R @ rotation_of(mean[3:]) @ _OPTICAL.T
    rpy = (
        np.arctan2(turned[2, 1], turned[2, 2]),
        -np.arcsin(np.clip(turned[2, 0], -1.0, 1.0)),
        np.arctan2(turned[1, 0], turned[0, 0]),
    )
    to_base = np.kron(np.eye(2), R)
    sigmas = np.sqrt(np.diag(to_base @ cov @ to_base.T))
    return {
        f"camera.{axis}": (float(value), float(s)) for axis, value, s in zip(_AXES, [*T, *rpy], sigmas, strict=True)
    }
