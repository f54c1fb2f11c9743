"""A survey: places and orientations of unknown markers, from images or corners of one or several drives.

1. Each drive by itself gives a trajectory (odometry, and markers as points).
2. Seen from there, the views of each marker agree on its pose; drives are joined by the markers that they share.
3. One graph of all drives refines trajectories, markers and the rest of the installation together (`survey_graph`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgloc.calibration.drives import Drive, drive
from fgloc.calibration.first_guess import Guess, aligned, guess, moved_poses, planar_matrix
from fgloc.calibration.found import Found, found_values
from fgloc.calibration.survey_graph import Distance, Leg, SurveyGraph
from fgloc.config import Config
from fgloc.errors import MapError, RecordingError
from fgloc.replay.options import Progress
from fgloc.sensors import registry
from fgloc.types import FloatArray, Landmark, LandmarkMap

_KNOWN_M, _KNOWN_RAD = 0.1, 0.2  # sigmas of a marker that is not known yet
_CONTRADICTS = 4.0  # sigmas by which a measured distance may miss


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """What came out.

    Attributes:
        landmarks: the map, each marker with its covariance ``(6, 6)``.
        views: sightings of each marker that the map is made of, by id.
        left_out: markers that were seen but are not in the map, with the reason.
        installation: what was found besides, by name.
        notes: what the user should know, one sentence each.
    """

    landmarks: LandmarkMap
    views: Mapping[int, int]
    left_out: Mapping[int, str]
    installation: Found
    notes: tuple[str, ...]


def survey(
    bags: Sequence[Path],
    config: Config,
    given: LandmarkMap | None = None,
    distances: Sequence[Distance] = (),
    progress: Progress | None = None,
) -> Survey:
    """Survey markers.

    Args:
        bags: recordings of one robot, with images or corners.
        config: with dictionary and size of the markers.
        given: markers that are known, with their sigmas: they make the frame, and are refined. None: the first pose of
            the first recording is the origin.
        distances: measured between two markers' middles.
        progress: called now and then.

    Raises:
        FglocError: a recording cannot be used, nothing is seen often enough, or recordings have no marker in common.
    """
    drives = [drive(bag, config, progress) for bag in bags]
    anchors = {i: m for i, m in (given.landmarks if given is not None else {}).items() if m.size_m > 0.0}
    seen = Counter({i: n for one in drives for i, n in one.sightings.items()})
    size = registry.raw_landmarks().size(config) or 0.0
    sizes = dict.fromkeys(seen, size) | {i: m.size_m for i, m in anchors.items()}
    legs, start, left_out = _joined(drives, sizes, anchors, config.landmarks.min_sightings)
    _need_ends(distances, start, left_out)
    graph = SurveyGraph(legs, start, set(anchors), config, distances)
    graph.solve()
    surveyed, views = graph.landmarks(), graph.views()
    left_out |= _undetermined(graph, surveyed, views, set(anchors), config.landmarks.min_sightings)
    if not set(surveyed) - set(left_out):
        listed = "; ".join(f"marker {i}: {why}" for i, why in left_out.items())
        raise RecordingError(f"{bags[0]}: no marker can be surveyed: {listed}")
    kept = {i: m for i, m in surveyed.items() if i not in left_out}
    unseen = {i: m for i, m in (given.landmarks if given is not None else {}).items() if i not in kept}
    dictionary = registry.raw_landmarks().dictionary(config) or (given.dictionary if given is not None else "")
    landmarks = LandmarkMap(dict(sorted((kept | unseen).items())), dictionary, "surveyed")
    first = drives[0].parts
    found = found_values(graph.installation, graph.belief, first.config, first.camera, graph.landmark_map)
    notes = [note for one in drives for note in one.notes]
    notes += [f"Markers {sorted(unseen)} of the given map were not seen, and stay as given."] if unseen else []
    misfits = [(d, graph.misfit(d)) for d in distances]
    notes += [_missed(d, sigmas) for d, sigmas in misfits if sigmas > _CONTRADICTS]
    return Survey(landmarks, {i: views[i] for i in kept}, left_out, found, tuple(dict.fromkeys(notes)))


def _need_ends(distances: Sequence[Distance], start: Mapping[int, Landmark], left_out: Mapping[int, str]) -> None:
    absent = [i for d in distances for i in (d.first, d.second) if i not in start]
    if absent:
        raise MapError(
            f"marker {absent[0]}, to which a distance was measured, {left_out.get(absent[0], 'was not seen')}; "
            f"surveyed are {sorted(start)}"
        )


def _undetermined(
    graph: SurveyGraph, surveyed: Mapping[int, Landmark], views: Mapping[int, int], anchors: set[int], least: int
) -> dict[int, str]:
    """Markers that the solution does not determine well enough for a map, with the reason."""
    left_out = {}
    for i in sorted(set(surveyed) - anchors):
        sigma = np.sqrt(np.diag(surveyed[i].cov))  # type: ignore[arg-type]
        if views[i] < least:
            left_out[i] = f"{views[i]} of its sightings fit the rest"
        elif i in graph.undecided:
            left_out[i] = "its views fit two directions alike: look at it from the side and from nearer"
        elif sigma[:3].max() > _KNOWN_M or sigma[3:].max() > _KNOWN_RAD:
            left_out[i] = (
                f"known to {100.0 * sigma[:3].max():.0f} cm and {np.degrees(sigma[3:].max()):.0f} degrees only: look "
                "at it from nearer and from several places"
            )
    return left_out


def _joined(
    drives: Sequence[Drive], sizes: Mapping[int, float], anchors: Mapping[int, Landmark], least: int
) -> tuple[list[Leg], dict[int, Landmark], dict[int, str]]:
    """Drives and markers in one frame: that of the anchors, else of the first drive; and what is left out."""
    known = {i: _matrix(m) for i, m in anchors.items()}
    legs: list[Leg] = []
    left_out: dict[int, str] = {}
    waiting = []
    for one in drives:
        guesses, reasons = guess(one.poses, one.measure(sizes), sizes, least)
        left_out |= reasons
        waiting.append((one, guesses))
    while waiting:
        if known:
            waiting.sort(key=lambda item: -len(set(item[1]) & set(known)))
        one, guesses = waiting.pop(0)
        motion = aligned(known, {i: g.T for i, g in guesses.items()}) if known else np.zeros(3)
        if motion is None:
            others = "the given map" if not legs else "the recordings before it"
            raise RecordingError(
                f"{one.bag}: has no marker in common with {others}, or they hang elsewhere: seen are "
                f"{sorted(guesses)}, known {sorted(known)}"
            )
        for i, g in guesses.items():
            known.setdefault(i, planar_matrix(motion) @ g.T)
        free = bool(anchors) or bool(legs)
        legs.append(Leg(one, moved_poses(motion, one.poses), _agreeing(guesses), free))
    if not known:
        listed = "; ".join(f"marker {i}: {why}" for i, why in left_out.items())
        raise RecordingError(f"{drives[0].bag}: no marker can be surveyed: {listed or 'none was seen'}")
    start = {
        i: anchors[i] if i in anchors else Landmark(i, T[:3, 3], T[:3, :3], sizes[i]) for i, T in sorted(known.items())
    }
    seen = {i for leg in legs for i in leg.agreeing}
    return legs, {i: m for i, m in start.items() if i in seen}, {i: w for i, w in left_out.items() if i not in start}


def _agreeing(guesses: Mapping[int, Guess]) -> dict[int, frozenset[int]]:
    return {i: g.agreeing for i, g in guesses.items()}


def _matrix(landmark: Landmark) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = landmark.rotation, landmark.position
    return T


def _missed(d: Distance, sigmas: float) -> str:
    return (
        f"The distance of markers {d.first} and {d.second}, {d.metres:g} m, is {sigmas:.0f} sigmas from what is seen: "
        "check it, and the markers' size."
    )
