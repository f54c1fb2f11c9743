"""A finished run as an MCAP file of standard ROS 2 messages, for Foxglove, PlotJuggler, RViz and ``ros2 bag``."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from mcap.writer import CompressionType, Writer

from fgloc import se2
from fgloc.errors import TrajectoryError
from fgloc.files.atomic import atomic_file
from fgloc.recording import standard_messages as standard
from fgloc.recording.messages import Messages
from fgloc.types import FloatArray, LandmarkMap, Mode, Trajectory

ODOMETRY, POSE, PATH, MAP, TRUTH, TRUTH_PATH = (
    f"/fgloc/{name}" for name in ("odometry", "pose", "path", "map", "truth", "truth_path")
)
TYPES = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    PATH: "nav_msgs/msg/Path",
    TRUTH: "geometry_msgs/msg/PoseStamped",
    TRUTH_PATH: "nav_msgs/msg/Path",
    MAP: "visualization_msgs/msg/MarkerArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
_DIAGNOSTICS_NS = 1_000_000_000  # between two of them while the mode stays
_Timed = tuple[int, str, dict[str, Any]]  # stamp [ns], topic, message


class Run(Protocol):
    """Parts of a run that are exported: `fgloc.RunResult` has them, and so has the result of `fgloc.read_results`."""

    @property
    def trajectory(self) -> Trajectory:
        """Poses with covariances."""

    @property
    def modes(self) -> Sequence[Mode]:
        """Mode of each pose."""

    @property
    def truth(self) -> Trajectory | None:
        """If known, in the frame of the map."""

    @property
    def landmarks(self) -> LandmarkMap | None:
        """The map."""


def write_mcap(run: Run, path: Path, base_frame: str = "base_link") -> None:
    """Write a run as one MCAP file; it appears whole or not at all.

    Both paths and the map come first, so that a viewer shows them from the beginning on.

    Args:
        run: with at least one pose, and covariances.
        path: the file, replaced if it is there.
        base_frame: child frame of ``/tf`` and of the odometry.

    Raises:
        TrajectoryError: there is no pose, or no covariance.
        OutputError: the file cannot be written.
    """
    if not len(run.trajectory) or run.trajectory.covs is None:
        raise TrajectoryError(f"{path}: expected a run with poses and covariances; nothing was written")
    messages = Messages()
    with atomic_file(path, binary=True) as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="fgloc")
        channels: dict[str, int] = {}
        for sequence, (stamp, topic, message) in enumerate(_all(run, base_frame)):
            if topic not in channels:
                kind = TYPES[topic]
                schema = writer.register_schema(kind, "ros2msg", messages.definition(kind).encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], stamp, messages.encode(TYPES[topic], message), stamp, sequence)
        writer.finish()  # type: ignore[no-untyped-call]


def _all(run: Run, base_frame: str) -> Iterator[_Timed]:
    """Every message, in the order of time."""
    stamps, first = run.trajectory.stamps_ns.tolist(), int(run.trajectory.stamps_ns[0])
    if run.landmarks is not None:
        yield first, MAP, standard.map_markers(run.landmarks, first)
    yield first, PATH, standard.path(stamps, run.trajectory.poses, first)
    truth: Iterator[_Timed] = iter(())
    if run.truth is not None and len(run.truth):
        during = (run.truth.stamps_ns >= first) & (run.truth.stamps_ns <= stamps[-1])
        told = list(zip(run.truth.stamps_ns[during].tolist(), run.truth.poses[during], strict=True))
        yield first, TRUTH_PATH, standard.path((s for s, _ in told), (p for _, p in told), first)
        truth = ((s, TRUTH, standard.pose_stamped(s, p)) for s, p in told)
    yield from heapq.merge(_estimates(run, base_frame), truth, key=itemgetter(0))


def _estimates(run: Run, base_frame: str) -> Iterator[_Timed]:
    """Pose of each keyframe; tracker state at 1 Hz and on mode changes."""
    stamps, poses, covs = run.trajectory.stamps_ns.tolist(), run.trajectory.poses, run.trajectory.covs
    assert covs is not None
    last_mode, told_ns = None, 0
    told = zip(stamps, poses, covs, _twists(run.trajectory), run.modes, strict=True)
    for i, (stamp, pose, cov, twist, mode) in enumerate(told):
        ground = run.trajectory.ground_at(i)
        yield stamp, ODOMETRY, standard.odometry(stamp, pose, cov, twist, base_frame, ground=ground)
        yield stamp, POSE, standard.pose_with_covariance_stamped(stamp, pose, cov, ground)
        yield stamp, "/tf", standard.transform(stamp, pose, base_frame, ground)
        if mode is not last_mode or stamp - told_ns >= _DIAGNOSTICS_NS:
            last_mode, told_ns = mode, stamp
            x, y, yaw = np.sqrt(np.diag(cov)).tolist()
            sigmas = {"sigma_x_m": f"{x:.4f}", "sigma_y_m": f"{y:.4f}", "sigma_yaw_rad": f"{yaw:.4f}"}
            yield stamp, "/diagnostics", standard.diagnostics(stamp, mode, mode.value, sigmas)


def _twists(trajectory: Trajectory) -> FloatArray:
    """Mean body twist ``(n, 3)`` from the pose before [m/s, m/s, rad/s]; the first is the second's."""
    if len(trajectory) < 2:
        return np.zeros((len(trajectory), 3))
    seconds = np.diff(trajectory.stamps_ns) * 1e-9
    moved = [se2.log(se2.between(a, b)) for a, b in zip(trajectory.poses[:-1], trajectory.poses[1:], strict=True)]
    twists = np.array(moved) / seconds[:, None]
    return np.concatenate([twists[:1], twists])
