"""`Live`: a stream of events in, poses out, for robots' own loops and for ROS 2's wire."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np

from fgloc.config import Config, Role
from fgloc.errors import EstimatorError, FglocError
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.anchors import Anchor, MotionParts
from fgloc.live.estimation import Estimation, Settings
from fgloc.live.events import EventMaker
from fgloc.live.extrapolation import Extrapolator
from fgloc.live.process import EstimationProcess
from fgloc.live.reception import Reception
from fgloc.live.status import LivePose, LiveStatus
from fgloc.sensors.learned.sensor import learned_motion
from fgloc.sensors.maps import configured_map
from fgloc.types import Camera, Estimate, Event, LandmarkMap


class Live(EventMaker):
    """Localizes a robot while it drives.

    Events may be pushed from any thread, in the order in which they arrive; `push` takes microseconds. One thread
    estimates, one finds markers in images; with ``process`` both are in a process of their own. Poses are the same as
    those of `fgloc online` on a recording of the events, unless images had to be dropped.

    The parts of the run are built when everything has come in that they are built from (see ``roles``).

    Example:
        >>> from fgloc.config import Config
        >>> with Live(Config(), roles=("command",)) as live:
        ...     for k in range(40):
        ...         live.command(1_000_000_000 + k * 50_000_000, 0.2, 0.0)
        ...     done = live.wait(10.0)
        ...     pose = live.pose_at()
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | Path | None = None,
        *,
        state: Path | None = None,
        roles: Collection[Role] | None = None,
        camera: Camera | None = None,
        process: bool | EstimationProcess = False,
    ) -> None:
        """Start the threads; nothing is estimated before events come in.

        Args:
            config: all settings, as `load_config` reads them.
            landmark_map: the map, or its file; None: landmarks are estimated too.
            state: file that the state is saved to every second and at the end, and resumed from.
            roles: what will come in. The run begins when all of it is there; None: ``live.startup_s`` of the settings
                after the first event, by receive times, with what has come. With ``roles`` it begins then without
                those that are not there. What comes later joins later.
            camera: the calibrated and mounted camera, if no CameraInfo and transforms will tell it.
            process: estimate in another process (or in this one, which was started before), so that `push`, `pose_at`
                and the caller's own threads never wait for an update. It costs some processor time for every event.

        Raises:
            MapError, ModelError: as their loaders have it.
        """
        if isinstance(landmark_map, Path):
            landmark_map = configured_map(landmark_map, config)
        learned_motion(config, None)  # refuses a file now, not when the robot drives
        self._recording = config.recording
        self._lock = threading.RLock()  # of the reception: events go on in the order in which they came
        self._reception = Reception(config)
        self._results = _Results(config)
        settings = Settings(config, landmark_map, state, roles, camera)
        self._estimation = _begun(process, settings, self._results)

    def __enter__(self) -> Live:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    # --- in ---

    def push(self, event: Event, publisher: str = "") -> tuple[Event, ...]:
        """Take an event, in order of receipt. Never waits for estimation or detection.

        Args:
            event: any that a recording has.
            publisher: tells publishers of one topic apart; only the first is used, until it has sent nothing for 1 s.

        Returns:
            What is used from now on: mostly the event itself; with a corrected stamp if the topic's clock was reset;
            nothing if it is of a second publisher, or held back for a moment because its clock may have been reset.

        Raises:
            EstimatorError: `close` was called.
            FglocError: the run has failed: what it was fed cannot be used.
        """
        with self._lock:
            used = self._reception.receive(event, publisher)
            for received in used:
                motion = self._reception.motion(received)
                if motion is not None:
                    self._results.poses.add(motion)
            self._estimation.put(used)
        return tuple(used)

    def reset_pose(self, pose: Sequence[float], sigmas: Sequence[float] = (0.5, 0.5, 0.26)) -> None:
        """Go on from a given pose: x, y [m], yaw [rad] in the map, and their sigmas.

        Sightings that contradict it win: the robot is then found again on the map.

        Raises:
            EstimatorError: values that are none, or the run is closed.
        """
        mean, spread = np.asarray(pose, dtype=float), np.asarray(sigmas, dtype=float)
        if not (mean.shape == spread.shape == (3,) and np.isfinite([mean, spread]).all() and (spread > 0.0).all()):
            raise EstimatorError(f"pose {pose} with sigmas {sigmas}; expected three finite values and sigmas above 0")
        self._estimation.reset_pose(PoseWithCovariance(mean, np.diag(spread**2)))

    def subscribe(self, callback: Callable[[Estimate], None]) -> None:
        """Have a function called with every keyframe's estimate, in the thread that has it: it should be quick.

        One that raises is not called again; `status` says so.
        """
        self._results.subscribe(callback)

    # --- out ---

    def pose_at(self, stamp_ns: int | None = None) -> LivePose | None:
        """The pose at a time, propagated from the last keyframe before it by the motion sources.

        Args:
            stamp_ns: up to 5 s back; None: the newest that is known.

        Returns:
            None while no pose is known, or for a time of which nothing is known.

        Raises:
            FglocError: the run has failed.
        """
        self._estimation.check_failed()
        return self._results.poses.pose_at(stamp_ns)

    def status(self) -> LiveStatus:
        """How the run fares."""
        status = self._estimation.status()
        with self._lock:
            topics, notes = self._reception.topics(), self._reception.notes
            dropped = dict(self._reception.dropped + Counter(status.dropped))
        notes = tuple(dict.fromkeys((*notes, *self._results.notes, *status.notes)))
        return replace(status, topics=topics, dropped=dropped, notes=notes)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until everything that was pushed has been used; False if it was not in time.

        Raises:
            FglocError: the run has failed.
        """
        return self._estimation.wait(timeout_s)

    # --- end ---

    def save(self, path: Path) -> bool:
        """Save the state now; False while there is none to save.

        Raises:
            OutputError: the file cannot be written.
        """
        return self._estimation.save(path)

    def close(self) -> None:
        """Use what waits but for images, save the state, and end the threads. May be called again.

        Raises:
            OutputError: the state cannot be written.
        """
        self._estimation.close()

    def _deliver(self, event: Event) -> None:
        self.push(event)


def _begun(process: bool | EstimationProcess, settings: Settings, results: _Results) -> Estimation | EstimationProcess:
    if process is False:
        return Estimation(settings, results)
    other = EstimationProcess() if process is True else process
    other.begin(settings, results)
    return other


class _Results:
    """What the estimation found: poses to be asked for, and callbacks.

    Attributes:
        poses: at any time.
    """

    def __init__(self, config: Config) -> None:
        self.poses = Extrapolator(config)
        self._lock = threading.Lock()
        self._subscribers: list[Callable[[Estimate], None]] = []
        self._notes: list[str] = []

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know, one sentence each."""
        with self._lock:
            return tuple(self._notes)

    def subscribe(self, callback: Callable[[Estimate], None]) -> None:
        with self._lock:
            self._subscribers.append(callback)

    def built(self, parts: MotionParts) -> None:
        self.poses.begin(parts)

    def failed(self, error: FglocError) -> None:
        """The next call raises it."""

    def estimated(self, anchor: Anchor, estimate: Estimate) -> None:
        self.poses.anchor(anchor)
        with self._lock:
            subscribers = list(self._subscribers)
        for callback in subscribers:
            try:
                callback(estimate)
            except Exception as error:  # theirs: the robot still needs its pose
                failed = f"a subscriber failed and is not called any more: {type(error).__name__}: {error}"
                with self._lock:
                    self._subscribers.remove(callback)
                    self._notes.append(failed)
