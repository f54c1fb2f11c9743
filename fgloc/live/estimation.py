"""The estimation of a live run in threads of this process: events that have been received go in, estimates come out."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from fgloc.config import Config, Role
from fgloc.errors import OutputError
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.anchors import Outlet
from fgloc.live.engine import Engine
from fgloc.live.facts import LiveFacts
from fgloc.live.run import OnlineRun
from fgloc.live.state import Resumed, fingerprint, read_state, write_state
from fgloc.live.status import LiveStatus
from fgloc.types import Camera, Event, LandmarkMap

_SAVE_EVERY_S = 1.0
_COMPARE_EVERY_S = 0.5  # or less often, where nothing new is to be compared


@dataclass(frozen=True, slots=True, eq=False)
class Settings:
    """Of a live run, as `Live` has them. Can be pickled."""

    config: Config
    landmark_map: LandmarkMap | None
    state: Path | None
    roles: Collection[Role] | None
    camera: Camera | None


class Estimation:
    """A run, its threads, and its saved state.

    Attributes:
        run: what the threads feed.
    """

    def __init__(self, settings: Settings, outlet: Outlet) -> None:
        """Start the threads; what is found goes to ``outlet``."""
        landmark_map, self._state = settings.landmark_map, settings.state
        read = Resumed(None, "") if self._state is None else read_state(self._state, fingerprint(landmark_map))
        facts = LiveFacts(settings.config, settings.roles, settings.camera)
        self.run = OnlineRun(settings.config, landmark_map, facts, read.state)
        self._engine = Engine(self.run, outlet, settings.config.live)
        if read.note:
            self._note(read.note)
        self._saver = threading.Thread(target=self._save_regularly, name="fgloc-state", daemon=True)
        if self._state is not None:
            self._saver.start()
        self._comparer = threading.Thread(target=self._compare_regularly, name="fgloc-diagnosis", daemon=True)
        self._comparer.start()

    def put(self, events: Iterable[Event]) -> None:
        """Queue events.

        Raises:
            EstimatorError: `close` was called.
            FglocError: the run has failed.
        """
        self._engine.put(events)

    def reset_pose(self, belief: PoseWithCovariance) -> None:
        """Queue a pose to go on from; raises as `put`."""
        self._engine.reset_pose(belief)

    def check_failed(self) -> None:
        """Raises: FglocError: the run has failed."""
        self._engine.check_failed()

    def wait(self, timeout_s: float | None) -> bool:
        """As `Live.wait`."""
        return self._engine.wait(timeout_s)

    def status(self) -> LiveStatus:
        """How it fares, but for what is known of topics where they are received."""
        run, engine = self.run, self._engine
        with engine.busy:
            newest, rejections, findings = run.newest, run.rejections, run.findings()
            keyframes, running, waiting = run.keyframes, run.parts is not None, run.facts.waiting_for()
            reordering_s = run.reordering_s
        with engine.changed:
            worker = engine.worker
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
                dropped=dict(engine.dropped + Counter({"image": worker.dropped})),
                rejections=dict(sorted(rejections.items())),
                waiting_for=waiting,
                notes=tuple(dict.fromkeys((*engine.notes, *(f.text for f in findings)))),
                findings=findings,
            )

    def save(self, path: Path) -> bool:
        """As `Live.save`."""
        with self._engine.busy:
            snapshot = self.run.snapshot()
        if snapshot is not None:
            write_state(path, snapshot)
        return snapshot is not None

    def close(self) -> None:
        """As `Live.close`."""
        if not self._engine.close():
            return
        self._comparer.join()
        if self._state is not None:
            self._saver.join()
            self.save(self._state)

    def _note(self, text: str) -> None:
        with self._engine.changed:
            self._engine.notes.setdefault(text)

    def _compare_regularly(self) -> None:
        """Compare signals beside the estimation, which goes on meanwhile."""
        while self._engine.pause(_COMPARE_EVERY_S):
            with self._engine.busy:
                comparison = self.run.comparison()
            if comparison is not None:
                comparison()

    def _save_regularly(self) -> None:
        while self._engine.pause(_SAVE_EVERY_S):
            try:
                assert self._state is not None
                self.save(self._state)
            except OutputError as error:
                self._note(str(error))
