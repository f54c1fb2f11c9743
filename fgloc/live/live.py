"""`Live`: a stream of events in, poses out, for robots' own loops and for ROS 2's wire."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from fgloc.config import Config, Role
from fgloc.errors import EstimatorError, OutputError
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.engine import Engine
from fgloc.live.events import EventMaker
from fgloc.live.facts import LiveFacts
from fgloc.live.run import OnlineRun
from fgloc.live.state import Resumed, fingerprint, read_state, write_state
from fgloc.live.status import LivePose, LiveStatus
from fgloc.sensors.learned import load_model
from fgloc.sensors.maps import load_map
from fgloc.types import Camera, Estimate, Event, LandmarkMap

_SAVE_EVERY_S = 1.0


class Live(EventMaker):
    """Localizes a robot while it drives.

    Events may be pushed from any thread, in the order in which they arrive; `push` takes microseconds. One thread
    estimates, one finds markers in images. Poses are the same as those of `fgloc online` on a recording of the events,
    unless images had to be dropped.

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
        startup_s: float = 2.0,
        image_queue: int = 4,
    ) -> None:
        """Start the threads; nothing is estimated before events come in.

        Args:
            config: all settings, as `load_config` reads them.
            landmark_map: the map, or its file; None: landmarks are estimated too.
            state: file that the state is saved to every second and at the end, and resumed from.
            roles: what will come in. The run begins when all of it is there; None: after ``startup_s``.
            camera: the calibrated and mounted camera, if no CameraInfo and transforms will tell it.
            startup_s: how long roles are waited for, by receive times. What comes later joins later.
            image_queue: images that may wait for detection; of more the oldest is dropped.

        Raises:
            MapError, ModelError: as their loaders have it.
        """
        if isinstance(landmark_map, Path):
            landmark_map = load_map(landmark_map, config.markers.default_size_m)
        if config.motion.use and config.motion.model is not None:
            load_model(config.motion.model)  # a file that cannot be used is refused now, not when the robot drives
        self._recording = config.recording
        self._state = state
        read = Resumed(None, "") if state is None else read_state(state, fingerprint(landmark_map))
        self._run = OnlineRun(config, landmark_map, LiveFacts(config, roles, camera), read.state)
        self._engine = Engine(self._run, startup_s, image_queue)
        if read.note:
            self._engine.reception.note(read.note)
        self._saver = threading.Thread(target=self._save_regularly, name="fgloc-state", daemon=True)
        if state is not None:
            self._saver.start()

    def __enter__(self) -> Live:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    # --- in ---

    def push(self, event: Event, publisher: str = "") -> None:
        """Take an event, in order of receipt. Never waits for estimation or detection.

        Args:
            event: any that a recording has.
            publisher: tells publishers of one topic apart; only the first is used, until it has been silent for 1 s.

        Raises:
            EstimatorError: `close` was called.
            FglocError: the run has failed: what it was fed cannot be used.
        """
        self._engine.put(event, publisher)

    def reset_pose(self, pose: Sequence[float], sigmas: Sequence[float] = (0.5, 0.5, 0.26)) -> None:
        """Go on from a pose that somebody tells: x, y [m], yaw [rad] in the map, and their sigmas.

        Sightings that contradict it win: the robot is then found again on the map.

        Raises:
            EstimatorError: values that are none, or the run is closed.
        """
        mean, spread = np.asarray(pose, dtype=float), np.asarray(sigmas, dtype=float)
        if not (mean.shape == spread.shape == (3,) and np.isfinite([mean, spread]).all() and (spread > 0.0).all()):
            raise EstimatorError(f"pose {pose} with sigmas {sigmas}; expected three finite values and sigmas above 0")
        self._engine.reset_pose(PoseWithCovariance(mean, np.diag(spread**2)))

    def subscribe(self, callback: Callable[[Estimate], None]) -> None:
        """Have a function called with every keyframe's estimate, in the estimation thread: it should be quick.

        One that raises is not called again; `status` says so.
        """
        self._engine.subscribe(callback)

    # --- out ---

    def pose_at(self, stamp_ns: int | None = None) -> LivePose | None:
        """The pose at a time, carried on from the last keyframe before it by the motion sources.

        Args:
            stamp_ns: up to 5 s back; None: the newest that is known.

        Returns:
            None while no pose is known, or for a time of which nothing is known.

        Raises:
            FglocError: the run has failed.
        """
        self._engine.check_failed()
        extrapolator = self._run.extrapolator
        return None if extrapolator is None else extrapolator.pose_at(stamp_ns)

    def status(self) -> LiveStatus:
        """How the run fares."""
        run, engine = self._run, self._engine
        with engine.busy:
            newest, rejections, notes = run.newest, run.rejections, run.notes()
            keyframes, running, waiting = run.keyframes, run.parts is not None, run.facts.waiting_for()
            reordering_s = run.reordering_s
        with engine.changed:
            worker, reception = engine.worker, engine.reception
            rejections += worker.rejections
            return LiveStatus(
                running=running,
                mode=None if newest is None else newest.mode,
                stamp_ns=None if newest is None else newest.stamp_ns,
                keyframes=keyframes,
                step_ms=engine.step_s * 1e3,
                step_ms_max=engine.longest_s * 1e3,
                reordering_s=reordering_s,
                queued_events=engine.queued,
                queued_images=worker.queued,
                topics=reception.topics(),
                dropped=dict(reception.dropped + Counter({"image": worker.dropped})),
                rejections=dict(sorted(rejections.items())),
                waiting_for=waiting,
                notes=tuple(dict.fromkeys((*reception.notes, *notes))),
            )

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until everything that was pushed has been used; False if it was not in time.

        Raises:
            FglocError: the run has failed.
        """
        return self._engine.wait(timeout_s)

    # --- end ---

    def save(self, path: Path) -> bool:
        """Save the state now; False while there is none to save.

        Raises:
            OutputError: the file cannot be written.
        """
        with self._engine.busy:
            snapshot = self._run.snapshot()
        if snapshot is not None:
            write_state(path, snapshot)
        return snapshot is not None

    def close(self) -> None:
        """Use what waits but for images, save the state, and end the threads. May be called again.

        Raises:
            OutputError: the state cannot be written.
        """
        if self._engine.close() and self._state is not None:
            self._saver.join()
            self.save(self._state)

    def _deliver(self, event: Event) -> None:
        self.push(event)

    def _save_regularly(self) -> None:
        while self._engine.pause(_SAVE_EVERY_S):
            try:
                assert self._state is not None
                self.save(self._state)
            except OutputError as error:
                with self._engine.changed:
                    self._engine.reception.note(str(error))
