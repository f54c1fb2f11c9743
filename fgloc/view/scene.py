"""Scene of a run for rerun (map, robot, covariance, sightings, modes, error), live or in a file."""

from __future__ import annotations

import bisect
import threading
from collections import defaultdict, deque
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.config import Config
from fgloc.errors import OutputError
from fgloc.files.atomic import atomic_file
from fgloc.results import RunData
from fgloc.types import Decision, Estimate, FloatArray, Landmark, LandmarkMap

if TYPE_CHECKING:
    from rerun import RecordingStream


_TIMELINE = "time"
_WITHIN = 2.4477  # half axes of the ellipse that holds 95 %, in sigmas: √(χ² of 2 degrees of freedom)
_FLAT_M = 0.005  # thickness of what is drawn flat
_POINT_M = 0.1  # size of a landmark without one
_ROBOT_M = (0.2, 0.15, 0.06)  # half sizes of the box that stands for it
_CHUNK = 100  # poses of a path in one entity: each new one sends these again
_TRUTH_KEPT_S = 10.0
_COLOURS = {
    "robot": (60, 130, 220),
    "path": (60, 130, 220),
    "truth": (150, 150, 150),
    "covariance": (240, 200, 40),
    "landmarks": (235, 235, 235),
    "accepted": (70, 190, 90),
    "rejected": (225, 60, 60),
}
_MODES = {
    "OK": (70, 190, 90),
    "UNCONFIRMED": (150, 150, 150),
    "DEAD_RECKONING": (240, 160, 40),
    "LOST": (225, 60, 60),
}


class Scene:
    """Sends a run to a rerun recording stream, estimate by estimate; thread-safe as that is."""

    def __init__(self, stream: RecordingStream, max_gap_s: float) -> None:
        """Set up the views; ``max_gap_s``: the truth is not interpolated across longer gaps."""
        self._rr = import_rerun()
        self._stream = stream
        self._max_gap_ns = round(max_gap_s * 1e9)
        self._paths: dict[str, tuple[int, list[FloatArray]]] = {}
        self._truth: deque[tuple[int, FloatArray]] = deque()
        self._landmarks: dict[int, Landmark] = {}
        self._mode = ""
        self._lock = threading.Lock()  # of the truth
        stream.send_blueprint(_blueprint())
        box = self._rr.Boxes3D(half_sizes=[_ROBOT_M], centers=[(0.0, 0.0, _ROBOT_M[2])], colors=[_COLOURS["robot"]])
        stream.log("map", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log("map/robot/body", box, static=True)
        modes = self._rr.StateConfiguration(values=list(_MODES), colors=list(_MODES.values()))
        stream.log("mode", modes, static=True)
        ahead = self._rr.Arrows3D(vectors=[(2.0 * _ROBOT_M[0], 0.0, 0.0)], colors=[_COLOURS["robot"]])
        stream.log("map/robot/ahead", ahead, static=True)

    def add_map(self, landmarks: LandmarkMap) -> None:
        """Draw the landmarks: plates and balls with their numbers."""
        self._landmarks = dict(landmarks.landmarks)
        markers = [m for m in self._landmarks.values() if m.size_m > 0.0]
        points = [m for m in self._landmarks.values() if m.size_m == 0.0]
        if markers:
            boxes = self._rr.Boxes3D(
                half_sizes=[(0.5 * m.size_m, 0.5 * m.size_m, _FLAT_M) for m in markers],
                centers=[m.position for m in markers],
                quaternions=[_quaternion(m.rotation) for m in markers],
                colors=[_COLOURS["landmarks"]],
                labels=[str(m.landmark_id) for m in markers],
                fill_mode="solid",
            )
            self._stream.log("map/markers", boxes, static=True)
        if points:
            balls = self._rr.Points3D(
                [m.position for m in points],
                radii=[0.5 * _POINT_M],
                colors=[_COLOURS["landmarks"]],
                labels=[str(m.landmark_id) for m in points],
            )
            self._stream.log("map/points", balls, static=True)

    def add_truth(self, stamp_ns: int, pose: FloatArray) -> None:
        """Add a true position of the base, in order of stamp; before the estimates that are compared with it."""
        with self._lock:
            if self._truth and stamp_ns <= self._truth[-1][0]:
                self._truth.clear()
            self._truth.append((stamp_ns, pose))
            while self._truth[0][0] < stamp_ns - round(_TRUTH_KEPT_S * 1e9):
                self._truth.popleft()

    def add(self, estimate: Estimate) -> None:
        """Draw one estimate, and what was decided on its sightings."""
        rr, stream = self._rr, self._stream
        stream.set_time(_TIMELINE, timestamp=np.datetime64(estimate.stamp_ns, "ns"))
        x, y, yaw = estimate.pose
        turned = rr.RotationAxisAngle(axis=(0.0, 0.0, 1.0), radians=yaw)
        stream.log("map/robot", rr.Transform3D(translation=(x, y, 0.0), rotation=turned))
        stream.log("map/covariance", self._ellipse(estimate))
        self._extend("path", np.array([x, y, _FLAT_M]))
        self._draw_sightings(estimate)
        sigmas = np.sqrt(np.linalg.eigvalsh(estimate.cov[:2, :2]).max()), np.sqrt(estimate.cov[2, 2])
        stream.log("position/sigma", rr.Scalars(sigmas[0]))
        stream.log("yaw/sigma", rr.Scalars(sigmas[1]))
        if (truth := self._truth_at(estimate.stamp_ns)) is not None:
            self._extend("truth", np.array([truth[0], truth[1], 0.0]))
            stream.log("position/error", rr.Scalars(float(np.hypot(x - truth[0], y - truth[1]))))
            stream.log("yaw/error", rr.Scalars(abs(se2.wrap(yaw - truth[2]))))
        if estimate.mode != self._mode:
            self._mode = str(estimate.mode)
            stream.log("mode", rr.StateChange(state=self._mode))

    def note(self, sentence: str) -> None:
        """Show a sentence at the time of the last estimate."""
        self._stream.log("notes", self._rr.TextLog(sentence))

    def _ellipse(self, estimate: Estimate) -> Any:
        variances, axes = np.linalg.eigh(estimate.cov[:2, :2])
        half = _WITHIN * np.sqrt(np.maximum(variances, 0.0))
        turned = self._rr.RotationAxisAngle(axis=(0.0, 0.0, 1.0), radians=float(np.arctan2(axes[1, 0], axes[0, 0])))
        return self._rr.Ellipsoids3D(
            half_sizes=[(half[0], half[1], _FLAT_M)],
            centers=[(estimate.pose[0], estimate.pose[1], 0.0)],
            rotation_axis_angles=[turned],
            colors=[_COLOURS["covariance"]],
            fill_mode="majorwireframe",
        )

    def _extend(self, name: str, point: FloatArray) -> None:
        """Add one more pose to a path."""
        chunk, points = self._paths.get(name, (0, []))
        points.append(point)
        line = self._rr.LineStrips3D(
            [np.array(points)], colors=[_COLOURS[name]], radii=[self._rr.Radius.ui_points(2.0)]
        )
        self._stream.log(f"map/{name}/{chunk}", line)
        self._paths[name] = (chunk + 1, points[-1:]) if len(points) >= _CHUNK else (chunk, points)

    def _draw_sightings(self, estimate: Estimate) -> None:
        """Draw lines to the landmarks that were seen."""
        start = (estimate.pose[0], estimate.pose[1], _ROBOT_M[2])
        for name, decisions in (
            ("accepted", [d for d in _of_landmarks(estimate.decisions) if d.weight > 0.0]),
            ("rejected", [d for d in _of_landmarks(estimate.decisions) if d.weight == 0.0]),
        ):
            seen = [d for d in decisions if d.landmark_id in self._landmarks]
            lines = self._rr.LineStrips3D(
                [[start, self._landmarks[d.landmark_id].position] for d in seen],
                colors=[_COLOURS[name]],
                labels=[d.reason for d in seen] if name == "rejected" else None,
            )
            self._stream.log(f"map/sightings/{name}", lines)

    def _truth_at(self, stamp_ns: int) -> FloatArray | None:
        with self._lock:
            truth = list(self._truth)
        stamps = [stamp for stamp, _ in truth]
        after = bisect.bisect_left(stamps, stamp_ns)
        if after < len(stamps) and stamps[after] == stamp_ns:
            return truth[after][1]
        if after in (0, len(stamps)) or stamps[after] - stamps[after - 1] > self._max_gap_ns:
            return None
        poses = np.array([truth[after - 1][1], truth[after][1]])
        around = np.array(stamps[after - 1 : after + 1], dtype=np.int64)
        return np.asarray(se2.interpolate(around, poses, np.array([stamp_ns], dtype=np.int64))[0])


def new_stream() -> RecordingStream:
    """A recording stream that goes nowhere yet.

    Raises:
        OutputError: rerun is not installed.
    """
    stream: RecordingStream = import_rerun().RecordingStream("fgloc")
    return stream


def import_rerun() -> Any:
    """Import rerun.

    Raises:
        OutputError: it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise OutputError(f"rerun cannot be loaded ({error}); install it: pip install 'fgloc[view]'") from error
    return rerun


def _of_landmarks(decisions: Iterable[Decision]) -> list[Decision]:
    return [decision for decision in decisions if decision.landmark_id >= 0]


def _quaternion(rotation: FloatArray) -> Any:
    return Rotation.from_matrix(rotation).as_quat()


def _blueprint() -> Any:
    """The map at the left; error, sigma, mode and notes at the right."""
    import rerun.blueprint as rrb

    curves = [
        rrb.TimeSeriesView(origin=name, name=f"{name} [{unit}]") for name, unit in (("position", "m"), ("yaw", "rad"))
    ]
    beside = rrb.Vertical(
        *curves,
        rrb.StateTimelineView(origin="mode", name="mode"),
        rrb.TextLogView(origin="notes", name="notes"),
        row_shares=[3, 3, 2, 2],
    )
    map_view = rrb.Spatial3DView(origin="map", name="map")
    return rrb.Blueprint(rrb.Horizontal(map_view, beside, column_shares=[3, 2]), collapse_panels=True)


# --- Files ------------------------------------------------------------------------------------------------------------


def write_rrd(result: RunData, path: Path) -> None:
    """Write a run as an ``.rrd``; the file appears whole or not at all. A truth in another frame is left out.

    Raises:
        OutputError: rerun is not installed, or the file cannot be written.
    """
    stream = new_stream()
    encoded = stream.binary_stream()  # rerun's own writer waits for ever where the disk is full
    draw(result, stream)
    content = encoded.read() or b""
    stream.disconnect()
    with atomic_file(path, binary=True) as file:
        file.write(content)


def draw(result: RunData, stream: RecordingStream) -> None:
    """Send a run to a rerun recording stream, from its beginning to its end."""
    settings = (result.config or Config()).truth
    scene = Scene(stream, settings.max_gap_s)
    if result.landmarks is not None:
        scene.add_map(result.landmarks)
    truth = result.truth if settings.align == "none" else None
    next_truth = 0
    decisions: dict[int, list[Decision]] = defaultdict(list)
    for decision in result.decisions:
        decisions[decision.stamp_ns].append(decision)
    covs = result.trajectory.covs
    assert covs is not None  # an estimated trajectory has them
    for k, stamp in enumerate(result.trajectory.stamps_ns.tolist()):
        while (
            truth is not None
            and next_truth < len(truth)
            and (next_truth == 0 or truth.stamps_ns[next_truth - 1] < stamp)
        ):
            scene.add_truth(int(truth.stamps_ns[next_truth]), truth.poses[next_truth])
            next_truth += 1
        decided = tuple(decisions.get(stamp, ()))
        scene.add(Estimate(stamp, result.trajectory.poses[k], covs[k], result.modes[k], decided))
    for note in result.notes:
        scene.note(note)
