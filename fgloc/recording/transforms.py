"""The tree of frames that a recording's ``/tf_static`` and ``/tf`` describe."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fgloc.errors import RecordingError
from fgloc.frames import BASE_NAMES, quaternion_matrix, transform_matrix
from fgloc.types import FloatArray, TransformEvent

_SAME_M = 1e-3
_SAME_RAD = 1e-3
_REMEDY = (
    "record /tf_static, or give the sensor's place in the configuration "
    "(recording.sightings_pose: [x, y, z, roll, pitch, yaw])"
)


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    T: FloatArray  # (4, 4) T_parent_child
    moves: bool


class FrameTree:
    """Rigid transforms between frames."""

    def __init__(self, transforms: Iterable[TransformEvent] = ()) -> None:
        """Collect the transforms. A frame pair that is published again with another pose moves, unless it is static.

        Transforms with a rotation that is not one, or with a frame inside itself, are left out.
        """
        self._edges: dict[tuple[str, str], _Edge] = {}
        for t in transforms:
            key = (_bare(t.parent), _bare(t.child))
            if key[0] == key[1] or not (np.isfinite(t.translation).all() and (np.abs(t.rotation) < 2.0).all()):
                continue
            norm = float(np.linalg.norm(t.rotation))
            if abs(norm - 1.0) > 0.05:
                continue
            known = self._edges.get(key)
            if known is None or t.static:
                self._edges[key] = _Edge(transform_matrix(t.translation, t.rotation / norm), False)
            elif not known.moves and _differ(known.T, t.translation, t.rotation / norm):
                self._edges[key] = _Edge(known.T, True)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        return tuple(sorted({name for edge in self._edges for name in edge}))

    @property
    def moving(self) -> tuple[tuple[str, str], ...]:
        """Parent and child of each transform that changes, sorted."""
        return tuple(sorted(pair for pair, edge in self._edges.items() if edge.moves))

    def __contains__(self, frame: str) -> bool:
        return _bare(frame) in self.frames

    def lookup(self, parent: str, child: str) -> FloatArray:
        """``T_parent_child`` ``(4, 4)``, along whatever transforms join the two frames.

        Raises:
            RecordingError: a frame is not there, the two are not joined, or one moves against the other.
        """
        parent, child = _bare(parent), _bare(child)
        if parent == child:
            return np.eye(4)
        names = self.frames
        for name in (child, parent):
            if name not in names:
                there = f"the frames there are {', '.join(names)}" if names else "the recording has no transforms"
                raise RecordingError(
                    f"no transform from {parent!r} to {child!r}: frame {name!r} is missing; {there}; {_REMEDY}"
                )
        path = self._path(parent, child)
        if path is None:
            raise RecordingError(
                f"no transform from {parent!r} to {child!r}: both frames are there, but nothing joins them "
                f"(frames: {', '.join(names)}); {_REMEDY}"
            )
        T = np.eye(4)
        for a, b in path:
            edge = self._edges.get((a, b)) or self._edges[b, a]
            if edge.moves:
                raise RecordingError(
                    f"no fixed transform from {parent!r} to {child!r}: {b!r} moves against {a!r} during the recording; "
                    f"a sensor has to be fixed to the base, and what it sees to be in its own frame: tell a detector "
                    f"so that gives it in {child!r} (aruco_ros: reference_frame)"
                )
            T = T @ (edge.T if (a, b) in self._edges else np.linalg.inv(edge.T))
        return T

    def _path(self, start: str, end: str) -> list[tuple[str, str]] | None:
        """Frame pairs from start to end, breadth first; fixed transforms before moving ones."""
        for fixed_only in (True, False):
            neighbors: dict[str, list[str]] = {}
            for (a, b), edge in self._edges.items():
                if not (fixed_only and edge.moves):
                    neighbors.setdefault(a, []).append(b)
                    neighbors.setdefault(b, []).append(a)
            came_from = {start: start}
            queue = [start]
            for name in queue:
                for other in neighbors.get(name, ()):
                    if other not in came_from:
                        came_from[other] = name
                        queue.append(other)
            if end in came_from:
                path = []
                while end != start:
                    path.append((came_from[end], end))
                    end = came_from[end]
                return path[::-1]
        return None


def _bare(frame: str) -> str:
    """ROS 1 wrote frames with a leading slash."""
    return frame.lstrip("/")


TF_TOPIC = "tf:"
"""Beginning of the name that the pose of one frame in another has in place of a topic: ``tf:odom>base_link``."""


def pair_topic(parent: str, child: str) -> str:
    """Name of the pose of frame ``child`` in frame ``parent`` in tf, in place of a topic."""
    return f"{TF_TOPIC}{_bare(parent)}>{_bare(child)}"


def is_odometry_pair(topic: str, base_frame: str | None) -> bool:
    """Whether a pair's frames are those of an odometry; ``base_frame``: the robot's, None: one of the usual names."""
    parent, _, child = topic.removeprefix(TF_TOPIC).partition(">")
    bases = BASE_NAMES if base_frame is None else (_bare(base_frame),)
    return parent.rpartition("/")[2] == "odom" and (child in bases or child.rpartition("/")[2] in bases)


def _differ(T: FloatArray, translation: FloatArray, rotation: FloatArray) -> bool:
    if float(np.abs(T[:3, 3] - translation).max()) > _SAME_M:
        return True
    cosine = 0.5 * (float(np.trace(T[:3, :3].T @ quaternion_matrix(rotation))) - 1.0)
    return cosine < math.cos(_SAME_RAD)
