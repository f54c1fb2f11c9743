"""Noise of the wheels' motion, estimated from the landmarks of one recording by maximum evidence."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np
import yaml
from scipy.optimize import minimize

from fgloc.assembly import assemble
from fgloc.calibration.first_settings import RobotFile, with_findings
from fgloc.config import Config, NoiseDensity, base_roles, config_of_file, setting
from fgloc.errors import FglocError
from fgloc.graph.batch import of_whole_run
from fgloc.graph.contradictions import smoothed_within_priors
from fgloc.graph.measurement_log import Keyframe
from fgloc.graph.noise import FusionRules, NoiseBudget
from fgloc.recording.reader import open_recording
from fgloc.recording.storage import find_beside
from fgloc.replay import Progress
from fgloc.runner import replayed
from fgloc.sensors.base import with_values
from fgloc.types import Event, Finding, FloatArray, MotionMeasurement

_EXCERPT_S = 300.0  # from the beginning of the recording
_IMAGES_S = 60.0  # likewise, if it has images: to find the markers in them takes most of the time
_LEAST_STEPS = 100
_RANGE = math.log(4.0)  # of each factor, up and down
_PRIOR = math.log(3.0)  # sigma of its logarithm
_SIZE = 0.1  # sigma of the logarithm of the wheels' distances over those that sightings tell without a map
_MOST = 6.0  # no wheels are so bad: the sightings are wrong
_TELLS = 1.0  # by which the logarithm of the likelihood must grow
_FAR = 2.0  # with such a factor other sightings are accepted: a second round
_DISAGREES = 2.0  # scale on the covariance of wheels that differ from other sources more than they use to
_ACCURACY = 0.1  # of the logarithms


def with_motion_noise(robot: RobotFile, bag: Path, progress: Progress | None = None) -> RobotFile:
    """First settings of a robot, with the noise of its wheels where sightings determine it."""
    if not {"image", "sightings"} & base_roles(robot.roles):
        return robot
    try:
        config = config_of_file(yaml.safe_load(robot.text) or {})
        found = identify_motion_noise(bag, find_beside(bag, "map.yaml"), config, progress)
    except FglocError:  # why it cannot be smoothed, `info` and a run say
        return robot
    return (
        robot if found is None else replace(robot, text=with_findings(robot.text, [found]), found=(*robot.found, found))
    )


def identify_motion_noise(
    bag: Path, map_path: Path | None, config: Config, progress: Progress | None = None
) -> Finding | None:
    """Factors on the wheels' noise densities, of distances and of yaw, under which the recording is most likely.

    The recording is smoothed, its sightings, map and installation with the noise and priors that they have; then the
    evidence of the linear graph is maximised over both factors (`fgloc.graph.batch.BatchSmoother.evidence`). Steps
    in which the wheels were judged wrong, or at rest, keep their noise; in the others the scale by which a run follows
    the sources' disagreement is 1.

    A recording can show that the noise is larger. That it is smaller it shows only in part, as errors that last longer
    than a step seem smaller than they are: a factor below 1 is replaced by its root, and for commands by 1.

    Without a map the wheels alone say how large everything is, and ranges or markers that are a few per cent too long
    would pass for noise of the wheels: one more factor is free then, on the wheels' distances. It is not used further.

    Args:
        bag: the recording; its first five minutes are used, or one minute if it has images.
        map_path: marker map; None: landmarks are estimated too.
        config: of the robot.
        progress: called now and then.

    Returns:
        What to set, under the code "wheels.noise"; None: the densities are right, or the recording does not tell.

    Raises:
        FglocError: the recording cannot be smoothed.
    """
    total, gained, noise = np.ones(2), 0.0, config.wheels.noise
    for _ in range(2):
        tried = with_values(config, "wheels", {"noise": NoiseDensity(**_scaled(noise, total))})
        found = _most_likely(bag, map_path, tried, progress)
        if found is None:
            break
        factors, gain = found
        total, gained = total * factors, gained + gain
        if factors.max() < _FAR:
            break
    if not gained >= _TELLS or total.max() > _MOST:  # also if it is not a number
        return None
    value = f"{{{', '.join(f'{key}: {density:.3g}' for key, density in _scaled(noise, total).items())}}}"
    text = (
        f"The noise of the wheels' motion is {total[0]:.2g} times the assumed one along the way and {total[1]:.2g} "
        f"times in turns: so the sightings are more likely (gain of log-likelihood {gained:.0f}): "
        f"set {setting('wheels.noise')}: {value}."
    )
    return Finding("wheels.noise", text, lines={setting("wheels.noise"): value}, value=float(total[0]))


def _most_likely(
    bag: Path, map_path: Path | None, config: Config, progress: Progress | None
) -> tuple[FloatArray, float] | None:
    """Most likely factors ``(2,)`` and their gain of log-likelihood; None: too few steps have sound wheels."""
    with open_recording(bag, config.recording) as recording:
        parts = assemble(recording, map_path, config, True, causal=False)
        longest_s = _EXCERPT_S if parts.detector is None else _IMAGES_S
        replay = replayed(recording, parts, "batch", progress, {"events": lambda events: _first(events, longest_s)})
    log = parts.localizer.estimator.log
    factors = of_whole_run(log, parts.localizer.factors)
    if not replay.estimates or factors.installation.ground or not parts.wheels.source:
        return None
    solver, _ = smoothed_within_priors(log, factors, config.batch, config.estimator.gate_probability)
    sound = [_is_sound(frame) for frame in solver.frames]
    if sum(sound) < _LEAST_STEPS:
        return None
    rules = parts.localizer.motion.sources.rules

    sigmas = np.array([_PRIOR, _PRIOR] if factors.known else [_PRIOR, _PRIOR, _SIZE])

    def cost(logs: FloatArray) -> float:
        scale, size = np.exp(logs[[0, 0, 1]]), np.exp(logs[2:])
        motions = [
            _with_noise(frame, scale, size, rules) if ok else frame.motions
            for frame, ok in zip(solver.frames, sound, strict=True)
        ]
        return 0.5 * float(np.sum(np.square(logs / sigmas))) - solver.evidence(motions)

    simplex = np.vstack([np.zeros(len(sigmas)), np.diag([math.log(2.0), math.log(2.0), _SIZE][: len(sigmas)])])
    best = minimize(
        cost,
        simplex[0],
        method="Nelder-Mead",
        bounds=[(-_RANGE, _RANGE)] * len(sigmas),
        options={"initial_simplex": simplex, "xatol": _ACCURACY, "fatol": _TELLS},
    )
    least = 0.0 if rules.wheels_are_commands else 0.5
    logs = np.append(np.where(best.x[:2] < 0.0, least * best.x[:2], best.x[:2]), best.x[2:])
    return np.exp(logs[:2]), cost(np.append([0.0, 0.0], best.x[2:])) - cost(logs)


def _scaled(noise: NoiseDensity, factors: FloatArray) -> dict[str, float]:
    of_way, of_yaw = factors.tolist()
    return {key: value * (of_yaw if key.startswith("yaw") else of_way) for key, value in noise.model_dump().items()}


def _first(events: Iterator[Event], seconds: float) -> Iterator[Event]:
    """The events until so long after the first."""
    first = next(events, None)
    if first is not None:
        yield first
        yield from takewhile(lambda event: event.stamp_ns - first.stamp_ns < seconds * 1e9, events)


def _is_sound(frame: Keyframe) -> bool:
    """Whether the wheels measured the motion to a keyframe, and nothing says that they were wrong."""
    if not frame.motions or frame.readings.wheels is None or frame.prior is not None:
        return False
    budget = frame.budget
    return not (
        frame.readings.at_rest or budget.rejected or budget.scale > _DISAGREES or budget.overruled_cov is not None
    )


def _with_noise(
    frame: Keyframe, scale: FloatArray, size: FloatArray, rules: FusionRules
) -> tuple[MotionMeasurement, ...]:
    wheels = frame.readings.wheels
    assert wheels is not None
    scaled = replace(wheels, cov=wheels.cov * np.outer(scale, scale))
    if len(size):
        scaled = replace(scaled, motion=wheels.motion * [size[0], size[0], 1.0])
    readings = replace(frame.readings, wheels=scaled)
    return tuple(NoiseBudget().combine(readings, rules))
