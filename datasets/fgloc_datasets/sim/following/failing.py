"""Failures of sensors while the robot drives: those of the ablations, on events as they arrive."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import yaml
from pydantic import ValidationError

from fgloc.ablation.failures import Kidnap, Lift, Truncated, corrupt, generators
from fgloc.ablation.suite import FailureEntry
from fgloc.config import Config
from fgloc.errors import ConfigError
from fgloc.files.settings import sentences
from fgloc.sensors.failures import Failure, Scene
from fgloc.types import Event, LandmarkMap, TruthEvent
from fgloc_datasets.sim.sensors import EPOCH_NS

_NOW = "/now"  # topic of the events that only tell how late it is


class FailingSensors:
    """Events in order of receipt go in, those that are left come out.

    Attributes:
        landmark_map: what the robot is given for a map.
    """

    def __init__(
        self, failures: Sequence[Failure], config: Config, landmarks: LandmarkMap, duration_s: float, seed: int
    ) -> None:
        """Draw what is random in the failures.

        Raises:
            ConfigError: a failure that only a recording can have.
        """
        for failure in failures:
            if failure.stage != "recorded" or isinstance(failure, Kidnap | Lift | Truncated):
                raise ConfigError(
                    f"failure '{failure.kind}' changes recordings or what was found in images; while a robot drives "
                    "there are those of its messages: dropout, darkness, latency, encoder_dead, moved_marker, ..."
                )
        ids = tuple(sorted(landmarks.landmarks))
        rngs = generators(len(failures), seed)
        scenes = [Scene(EPOCH_NS, duration_s, config, ids, rng) for rng in rngs]
        self.landmark_map = landmarks
        for failure, scene in zip(failures, scenes, strict=True):
            self.landmark_map = failure.corrupt_map(self.landmark_map, scene)
        self._waiting: deque[Event] = deque()
        self._now_ns = 0
        self._out = corrupt(failures, "recorded", self._arriving(), scenes)

    def after(self, events: Iterable[Event], now_ns: int) -> Iterator[Event]:
        """What is left of events received up to now, and what was held back until now."""
        self._waiting.extend(events)
        self._now_ns = now_ns
        for event in self._out:
            if event.topic != _NOW:
                yield event
            elif event.received_ns > now_ns:
                return

    def _arriving(self) -> Iterator[Event]:
        """What waits; then the time, again and again: failures that hold events back let go of them by it."""
        while True:
            if self._waiting:
                yield self._waiting.popleft()
            else:
                self._now_ns += 1
                yield TruthEvent(self._now_ns, self._now_ns, _NOW, "", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def read_failures(texts: Sequence[str]) -> tuple[Failure, ...]:
    """Failures as a suite of ablations describes them, each a YAML mapping.

    Raises:
        ConfigError: no YAML, no such failure, or a wrong value.
    """
    if not texts:
        return ()
    try:
        return FailureEntry.model_validate({"name": "given", "chain": [yaml.safe_load(text) for text in texts]}).chain
    except yaml.YAMLError as error:
        raise ConfigError(f"--failure: no YAML ({error}); write {{kind: dropout, sensor: camera}}") from error
    except ValidationError as error:
        raise ConfigError("--failure: " + "; ".join(sentences(error, FailureEntry))) from error
