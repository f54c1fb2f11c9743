"""The installation calibrated on whole recordings: by the robot's sightings or, where it sees nothing, by a truth."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fgloc.calibration.installation import found_text, settings_found, with_settings
from fgloc.calibration.truth import calibrate_by_truth
from fgloc.config import Config, base_role, base_roles
from fgloc.errors import EstimatorError
from fgloc.extensions import outside_sensors
from fgloc.recording.reader import open_recording
from fgloc.recording.storage import find_beside
from fgloc.replay import Progress
from fgloc.runner import RunResult, run
from fgloc.sensors import registry
from fgloc.sensors.base import with_values
from fgloc.sensors.wheels.motion import DRIVE
from fgloc.sensors.wheels.sensor import DISTANCE_GAIN, freed, with_wheels
from fgloc.types import InstallationFound, Setting

_ROUNDS = 2  # with the gains of the first, other sightings are accepted and rejected than before
_FAR = 3.0  # of these sigmas that a gain may move at most
_UNSEEN = 0.95  # share of its sigma that is left to a gain that no measurement determines


def calibrate(
    bags: Sequence[Path], map_path: Path | None, config: Config, progress: Progress | None = None
) -> tuple[Config, tuple[Setting, ...]]:
    """Find the installation, with wide priors on the gains of the wheels or of commands in their place.

    Recordings without landmarks but with a truth calibrate the wheels alone, by the truth.

    Args:
        bags: one or more recordings of the robot.
        map_path: marker map; None: that beside each bag, if any.
        config: of the robot. A learned motion in it is not used.
        progress: called now and then.

    Returns:
        The configuration with what was found and its sigmas, and the settings as they were given and found.

    Raises:
        FglocError: a recording cannot be used, or holds no wheels or no sightings.
    """
    if all(map(partial(only_truth, config=config), bags)):
        return calibrate_by_truth(bags, config)
    now = config
    for _ in range(_ROUNDS):
        results = [_calibrated(bag, map_path, now, progress) for bag in bags]
        maps = {None if r.landmarks is None else r.landmarks.source for r in results}
        settings = pooled([r.found for r in results if r.found is not None], maps, now)
        values = {_key(s): round(s.found, 7) for s in _of_odometer(settings)}
        now = with_wheels(now, values)
    given = {s.name: _given(s, config) for s in _of_odometer(settings)}
    settings = tuple(replace(s, given=given.get(s.name, s.given)) for s in settings)
    _check(settings)
    return with_settings(config, settings), settings


def only_truth(bag: Path, config: Config) -> bool:
    """Whether nothing but a truth tells where the robot was."""
    with open_recording(bag, config.recording) as recording:
        seeing = {"image", "sightings", *(s.role for sensor in outside_sensors() for s in sensor.streams)}
        return "truth" in recording.roles and not seeing & base_roles(recording.roles)


def _of_odometer(settings: Sequence[Setting]) -> list[Setting]:
    return [s for s in settings if s.name.startswith("wheels.")]


def _key(setting: Setting) -> str:
    return setting.name.partition(".")[2]


def _given(setting: Setting, config: Config) -> float:
    drive = config.wheels.drive
    if drive is not None and setting.name.startswith(DRIVE):
        return drive.value(setting.name.removeprefix(DRIVE))
    return float(getattr(config.wheels, _key(setting)))


def _check(settings: Sequence[Setting]) -> None:
    wheels = _of_odometer(settings)
    if any(abs(s.found - s.given) > _FAR * s.prior_sigma for s in wheels):
        listed = ", ".join(f"{_key(s)} {found_text(s)}" for s in wheels)
        raise EstimatorError(
            f"the wheels cannot be calibrated on this run: {listed} is no robot's; see the rejections of "
            "`fgloc smooth`, and begin with gains that are less far off"
        )


def _calibrated(bag: Path, map_path: Path | None, config: Config, progress: Progress | None) -> RunResult:
    """The bag smoothed with wide priors on the wheels; on commands if there are no wheels."""
    map_path = map_path or find_beside(bag, "map.yaml")
    for tried in freed(with_values(config, "motion", {"use": False})):
        result = run(bag, map_path, tried, "batch", progress, check=False)
        if result.found is not None and result.found.wheels != "command":
            break
    if not any(base_role(kind) in registry.landmark_kinds() for kind, n in result.counts.items() if n):
        raise EstimatorError(
            f"{bag}: no sighting of a landmark was used, and without sightings nothing determines the "
            f"gains of the wheels; see `fgloc info {bag}`"
        )
    assert result.found is not None
    gain = next((s for s in result.found.settings if s.name in (DISTANCE_GAIN, f"{DRIVE}radius")), None)
    if not result.found.wheels or gain is None or gain.sigma > _UNSEEN * gain.prior_sigma:
        raise EstimatorError(
            f"{bag}: the gains of the wheels cannot be determined: between sightings there are no messages of wheels, "
            f"or of commands in their place (see wheels.source and `fgloc info {bag}`), or gains so far off that the "
            "sightings contradict every motion (begin with nearer ones)"
        )
    return result


def pooled(founds: Sequence[InstallationFound], maps: Collection[str | None], config: Config) -> tuple[Setting, ...]:
    """Settings estimated by several runs together: their information is added, that of the prior counts once.

    Args:
        founds: of each run.
        maps: that they used; landmarks are left out if these are several.
        config: of all runs.
    """
    first = founds[0]
    if len({f.wheels == "command" for f in founds}) > 1:
        raise EstimatorError(
            "some of the recordings have wheels and others only commands; calibrate on those with wheels, or set "
            "wheels.source"
        )
    if len(founds) == 1:
        return first.settings
    names = [n for n in dict.fromkeys(n for f in founds for n in f.names) if len(maps) == 1 or not n.startswith("map.")]
    places = []
    prior = np.eye(len(names))
    for f in founds:
        shared = [n for n in f.names if n in names]
        own, rows = [f.names.index(n) for n in shared], [names.index(n) for n in shared]
        prior[np.ix_(rows, rows)] = f.prior_cov[np.ix_(own, own)]
        places.append((own, rows))
    information, pull = np.linalg.inv(prior), np.zeros(len(names))
    for f, (own, rows) in zip(founds, places, strict=True):
        posterior = np.linalg.inv(f.cov[np.ix_(own, own)])
        information[np.ix_(rows, rows)] += posterior - np.linalg.inv(f.prior_cov[np.ix_(own, own)])
        pull[rows] += posterior @ f.mean[own]
    cov = np.asarray(np.linalg.inv(information))
    return settings_found(replace(first, names=tuple(names), mean=cov @ pull, cov=cov, prior_cov=prior), config)
