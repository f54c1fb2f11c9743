"""The check before a run: gross mistakes of map, camera, wheels, clocks and frames, each with the line that undoes it.

A bounded excerpt of the recording is fitted with the set-up as given (`setup_fit`). Only where it does not fit as an
ordinary installation would, every mistake of `setup_changes` is undone in turn and fitted too: the one with which the
cost falls to that of a sound set-up is named. The likelihood ratio of the two set-ups is what makes it sure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgloc.config import Config, Role
from fgloc.diagnosis.excerpt import Excerpt, Stretch, tells_place
from fgloc.diagnosis.setup_changes import Change, changes, gross, refined
from fgloc.diagnosis.setup_fit import Fit, Problem, Setup
from fgloc.diagnosis.setup_sentences import Correction, correction
from fgloc.types import Camera, FloatArray, LandmarkMap

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
    """What the check found.

    Attributes:
        fit: of the set-up as given; None where nothing could be fitted.
        correction: of the mistake; None if there is none, or none that is sure.
        corrected: the fit without the mistake, or `fit`; None where neither determines the poses.
        stretches: that were fitted.
        unexplained: whether the sightings fit the map nowhere, and no mistake explains it.
    """

    fit: Fit | None
    correction: Correction | None
    corrected: Fit | None
    stretches: Sequence[Stretch]
    unexplained: bool = False


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
        return Checked(fit, None, fit if seen_right else None, stretches, not seen_right)
    change, better = min(sure, key=lambda e: e[1].cost)
    wheels: Role = "joints" if excerpt.wheel_source == "ticks" else "odometry"
    sentence = correction(change, setup, excerpt.wheel_source, image, wheels)
    return Checked(fit, sentence, better, stretches)


def _small(tried: Iterable[Change], setup: Setup, fit: Fit) -> list[Change]:
    """Changes that are deviations only, those first that would lower the cost of a fit the most."""
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
    """A change fitted to the end: what was found is taken in, as angles are linearized, and fitted again."""
    last: Fit | None = None
    for _ in range(_REFINED):
        fit = Problem(stretches, change.setup, change.free).solve(poses)
        if fit is None:
            break
        change, poses = refined(change, fit), fit.poses
        done = last is not None and fit.cost > last.cost - _SAME
        last = fit
        if done or not change.linearized:
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
