"""Parameters of the node as fgloc's settings; without ROS, so that it can be tested anywhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgloc.config import Config, load_config, role_names
from fgloc.errors import ConfigError
from fgloc.live.live import begun_at
from fgloc.live.wire.node import RATE_HZ, Publishing
from fgloc.recording.transforms import TF_TOPIC
from fgloc.sensors.maps import configured_map
from fgloc.types import LandmarkMap

PARAMETERS: Mapping[str, tuple[Any, str]] = {
    "config": ("", "robot.yaml of fgloc; empty: defaults"),
    "map": ("", "map.yaml with the landmarks; empty: they are estimated"),
    "state": ("", "file that the state is saved to every second, and resumed from; empty: kept while the node runs"),
    "initial_pose": ([], "x, y [m], yaw [rad] in the map; empty: the map is searched"),
    "map_frame": ("map", "frame of the poses"),
    "odom_frame": ("", "frame that map_frame is connected with on /tf; empty: that of the odometry's messages"),
    "base_frame": ("", "frame of the robot; empty: as robot.yaml or the messages say"),
    "publish_tf": (True, "publish map_frame -> odom_frame"),
    "transform_tolerance": (0.0, "time by which stamps on /tf are ahead [s], as AMCL has it"),
    "rate": (RATE_HZ, "rate of ~/odometry [Hz]"),
}
"""Default and description of each parameter; besides, ``topics.ROLE`` for each role, and ``qos_overrides`` of ROS."""

_FASTEST_HZ, _FARTHEST_AHEAD_S = 200.0, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Settings:
    """Settings of one configured node."""

    config: Config
    landmarks: LandmarkMap | None
    map_file: Path | None
    state: Path | None
    publishing: Publishing


def settings(
    parameters: Mapping[str, Any],
    resolve: Callable[[str], str],
    remapped: Callable[[str], str | None],
    name: str,
) -> Settings:
    """Settings of a node by its parameters.

    Args:
        parameters: by name, as `PARAMETERS` has them, with ``topics.ROLE``.
        resolve: full name of a topic in the node's namespace.
        remapped: full name that a role's name was remapped to (``-r odometry:=/wheels/odom``); None: it was not.
        name: full name of the node.

    Raises:
        FglocError: a file cannot be read, or a value is out of its range.
    """
    map_file, state = (Path(parameters[key]) if parameters[key] else None for key in ("map", "state"))
    config = load_config(Path(parameters["config"])) if parameters["config"] else Config()
    config = _with_topics(config, parameters, resolve, remapped)
    config = _with_initial_pose(config, parameters["initial_pose"])
    if parameters["base_frame"]:
        config = _changed(config, "recording", base_frame=parameters["base_frame"])
    rate, ahead = float(parameters["rate"]), float(parameters["transform_tolerance"])
    if not 0.0 < rate <= _FASTEST_HZ:
        raise ConfigError(f"rate {rate:g} Hz: expected more than 0 and at most {_FASTEST_HZ:g}")
    if not 0.0 <= ahead <= _FARTHEST_AHEAD_S:
        raise ConfigError(f"transform_tolerance {ahead:g} s: expected 0 to {_FARTHEST_AHEAD_S:g}")
    if not parameters["map_frame"]:
        raise ConfigError("map_frame is empty; expected the name of a frame, such as map")
    publishing = Publishing(
        rate_hz=rate,
        map_frame=parameters["map_frame"],
        odom_frame=parameters["odom_frame"],
        tf=bool(parameters["publish_tf"]),
        tf_ahead_s=ahead,
        name=name.lstrip("/"),
    )
    landmarks = None if map_file is None else configured_map(map_file, config)
    return Settings(config, landmarks, map_file, state, publishing)


def _with_topics(
    config: Config,
    parameters: Mapping[str, Any],
    resolve: Callable[[str], str],
    remapped: Callable[[str], str | None],
) -> Config:
    """Topics of the roles: by parameter, else by remapping, else as robot.yaml has them, in the node's namespace."""
    topics: dict[str, str] = {}
    for role in role_names():
        by_file = config.recording.topics.given(role)
        given = parameters.get(f"topics.{role}", "")
        if given == "none" or (not given and not remapped(role) and by_file == "none"):
            topics[role] = "none"
        elif given:
            topics[role] = resolve(given)
        elif to := remapped(role):
            topics[role] = to
        elif by_file is not None and by_file.startswith(TF_TOPIC):
            if role != "truth":
                raise ConfigError(
                    f"recording.topics.{role}: {by_file} is read from recordings only, expected a topic: give the "
                    f"parameter topics.{role}"
                )
            topics[role] = "none"
        elif by_file is not None:
            topics[role] = resolve(by_file.lstrip("/"))
    return _changed(config, "recording", topics=config.recording.topics.model_copy(update=topics))


def _with_initial_pose(config: Config, given: Any) -> Config:
    if given is None or (not isinstance(given, (bool, int, float)) and not len(given)):
        return config
    pose = given if isinstance(given, Sequence) and not isinstance(given, (str, bytes)) else ()
    numbers = [float(value) for value in pose if isinstance(value, (int, float)) and math.isfinite(value)]
    if not len(numbers) == len(pose) == 3:
        raise ConfigError(f"initial_pose {given}: expected x, y [m] and yaw [rad], such as [1.5, -0.2, 3.14]")
    return begun_at(config, numbers, "initial_pose")


def _changed(config: Config, section: str, **values: Any) -> Config:
    return config.model_copy(update={section: getattr(config, section).model_copy(update=values)})
