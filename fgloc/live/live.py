"""`Live`: a stream of events in, poses out, for robots' own loops and for ROS 2's wire."""

from __future__ import annotations

import functools
import inspect
import reprlib
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import ValidationError

from fgloc.config import Config, EstimatorConfig, Role, known_role
from fgloc.errors import ConfigError, EstimatorError, FglocError
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.intake.clocks import Source, TopicClocks, source_of
from fgloc.intake.validation import EventValidator, reported_bounds
from fgloc.live.engine import Estimation, Keep, LiveStatus, Settings, TopicStatus
from fgloc.live.extrapolation import Anchor, Extrapolator, LivePose, MotionParts
from fgloc.live.process import EstimationProcess
from fgloc.live.run import MOST_NAMES, LiveFacts, role_name
from fgloc.sensors import registry
from fgloc.sensors.base import SENSOR, When
from fgloc.sensors.learned.sensor import learned_motion
from fgloc.sensors.maps import configured_map
from fgloc.types import (
    WHOLE_NS,
    Camera,
    CameraInfoEvent,
    Estimate,
    Event,
    FloatArray,
    LandmarkMap,
    MotionEvent,
    TransformEvent,
    whole_ns,
)

# --- Arguments as a caller gives them ---------------------------------------------------------------------------------

_SHAPES: Mapping[str, tuple[tuple[int | None, ...], str]] = {
    "pose": ((3,), "x, y [m] and yaw [rad]"),
    "twist": ((3,), "forward, left [m/s] and yaw rate [rad/s]"),
    "twist_cov": ((3, 3), "covariance of forward, left [m/s] and yaw rate [rad/s]"),
    "v": ((), "forward speed [m/s]"),
    "omega": ((), "yaw rate [rad/s]"),
    "angular_velocity": ((3,), "rates about x, y and z [rad/s]"),
    "linear_acceleration": ((3,), "accelerations along x, y and z [m/s²]"),
    "position": ((None,), "angles of the joints [rad]"),
    "velocity": ((None,), "rates of the joints [rad/s]"),
    "effort": ((None,), "torques of the joints [Nm]"),
    "landmarks": ((None, 3), "id, range [m] and bearing [rad] of each landmark"),
    "markers": ((4, 2), "corners [px], clockwise from its top left, by id of each marker"),
    "image": ((None, None), "a uint8 array (h, w) or (h, w, 3), or the bytes of a JPEG or PNG"),
    "K": ((3, 3), "camera matrix [px]"),
    "D": ((None,), "coefficients of the distortion"),
    "translation": ((3,), "x, y and z [m]"),
    "rotation": ((4,), "quaternion x, y, z, w"),
}
"""Shape (None: any length) and meaning of each argument of the methods that make events."""


def _numbers(name: str, value: Any, where: str) -> FloatArray:
    """An argument as numbers of its shape.

    Raises:
        EstimatorError: it is none; the message has the value and what was expected.
    """
    shape, meaning = _SHAPES[name]
    try:
        array: FloatArray = np.asarray(value, dtype=float)
        if any(part is None for part in np.asarray(value, dtype=object).ravel()):  # which numpy takes for NaN
            raise TypeError("None is no number")
    except (TypeError, ValueError):
        array = np.empty((0,) * (len(shape) + 1))
    fits = len(array.shape) == len(shape) and all(s is None or n == s for n, s in zip(array.shape, shape, strict=True))
    if not fits:
        size = " x ".join("n" if n is None else str(n) for n in shape) or "1"
        numbers = "1 number" if size == "1" else f"{size} numbers"
        raise EstimatorError(f"{where}: {name} is {reprlib.repr(value)}; expected {numbers}: {meaning}")
    return array


def _wrong_argument(method: Callable[..., Any], given: Mapping[str, Any]) -> None:
    """Raise the error that names the first argument which is not of its shape, if there is one."""
    for name, value in given.items():
        if name not in _SHAPES or (value is None and name in ("pose", "twist", "twist_cov")):
            continue
        if name == "markers" and isinstance(value, Mapping):
            for corners in value.values():
                _numbers(name, corners, method.__name__)
        elif name == "image":
            raise EstimatorError(f"{method.__name__}: image is {reprlib.repr(value)}; expected {_SHAPES[name][1]}")
        else:
            _numbers(name, value, method.__name__)


def _explained(method: Callable[..., Any]) -> Callable[..., Any]:
    """The method that makes events of plain numbers, with an error that names the argument it cannot use."""
    signature = inspect.signature(method)

    @functools.wraps(method)
    def called(self: Live, *args: Any, **kwargs: Any) -> Any:
        try:
            return method(self, *args, **kwargs)
        except (AttributeError, IndexError, TypeError, ValueError) as error:
            try:
                given = signature.bind(self, *args, **kwargs).arguments
            except TypeError:
                raise error from None  # of a call that Python itself refuses
            _wrong_argument(method, given)
            raise EstimatorError(
                f"{method.__name__}: {error}; expected values as help(fgloc.Live.{method.__name__}) has them"
            ) from error

    return called


# --- Reception: rates and delays by topic, publishers, and clocks that were reset -------------------------------------

_SILENT_NS = 2_000_000_000  # a topic that others outlive by this long is reported
# A publisher that sends nothing for this long has ended, and so has one from before the clock was set back by as much:
# another one of the topic is used.
_SUCCESSION_NS = 1_000_000_000


_MOST_TOPICS = 100  # that are received
_MEAN_OF = 20  # messages, in the means of their interval and delay
_clock_s = time.monotonic
_STALE_S, _STALE_INTERVALS = 0.6, 4.0  # of silence: a wireless link's hiccup is shorter; users hear of it within 1 s
_REGULAR_S = 1.0  # a topic that comes more often is missed


class _TopicMeter:
    """Rate and delay of one topic: exponential means over the last messages.

    Attributes:
        last_ns: when the last one was received.
    """

    def __init__(self, role: str) -> None:
        """Start without messages."""
        self._role = role
        self._count = 0
        self.last_ns = 0
        self._heard_s = 0.0
        self._interval_s = 0.0
        self._delay_s = 0.0

    def add(self, stamp_ns: int, received_ns: int) -> None:
        """Add one message."""
        delay = (received_ns - stamp_ns) * 1e-9
        if self._count:
            interval = max(received_ns - self.last_ns, 0) * 1e-9
            share = 1.0 / min(self._count, _MEAN_OF)
            self._interval_s += share * (interval - self._interval_s)
            self._delay_s += share * (delay - self._delay_s)
        else:
            self._delay_s = delay
        self._count += 1
        self.last_ns, self._heard_s = received_ns, _clock_s()

    @property
    def is_regular(self) -> bool:
        """Whether messages come so often that a silence is worth a note."""
        return self._role != "tf" and self._count > 2 and self._interval_s < _REGULAR_S

    def status(self) -> TopicStatus:
        """Statistics of the topic up to now."""
        rate = 1.0 / self._interval_s if self._interval_s > 0.0 else 0.0
        silent_s = _clock_s() - self._heard_s
        missed = self.is_regular and silent_s > max(_STALE_S, _STALE_INTERVALS * self._interval_s)
        return TopicStatus(self._role, self._count, rate, self._delay_s, silent_s, missed)


class Reception:
    """Receives every event as it arrives; used under the lock of its owner.

    Attributes:
        dropped: events that are not used whatever is in them, by role.
    """

    def __init__(self, config: Config) -> None:
        """Start without events."""
        self._topics = config.recording.topics
        self._selection = LiveFacts(config, None, None)
        self._gate = EventValidator(reported_bounds(config))
        self.dropped: Counter[str] = Counter()
        self._publishers: dict[Source, tuple[str, int]] = {}  # whose messages are used, and when the last was received
        self._meters: dict[str, _TopicMeter] = {}
        self._clocks = TopicClocks()
        self._notes: dict[str, None] = {}  # an ordered set

    def receive(self, event: Event, publisher: str) -> list[Event]:
        """Events that are to be used now: mostly this one; see `TopicClocks`."""
        role = role_name(event, self._topics)
        if event.topic not in self._meters and len(self._meters) >= _MOST_TOPICS:
            self.dropped[role] += 1
            self.note(f"more than {_MOST_TOPICS} topics: messages of further ones are not used")
            return []
        if not isinstance(event, TransformEvent) and not self._is_of_its_publisher(event, publisher):
            self.dropped[role] += 1
            self.note(
                f"{event.topic}: two publishers; only the messages of the first are used: stop or rename one of them"
            )
            return []
        if event.topic not in self._meters:
            self._meters[event.topic] = _TopicMeter(role)
        self._meters[event.topic].add(event.stamp_ns, event.received_ns)
        return self._clocks.correct(event)

    def _is_of_its_publisher(self, event: Event, publisher: str) -> bool:
        """Whether a message is of the one publisher that its topic should have; transforms have any number.

        Another one replaces it after a silence.
        """
        source, received_ns = source_of(event), event.received_ns
        name, heard_ns = self._publishers.pop(source, (publisher, received_ns))
        is_second = publisher != name and abs(received_ns - heard_ns) < _SUCCESSION_NS
        self._publishers[source] = (name, heard_ns) if is_second else (publisher, received_ns)  # the newest at the end
        if len(self._publishers) > MOST_NAMES:  # joints of ever new names on one topic
            del self._publishers[next(iter(self._publishers))]
        return not is_second

    def motion(self, event: Event) -> MotionEvent | None:
        """Event, as the gate lets it through, if it is of the motion source to be used; else None."""
        if not isinstance(event, MotionEvent) or not self._selection.topic_is_used(event):
            return None
        passed = self._gate.check(event)
        return passed if isinstance(passed, MotionEvent) else None

    def note(self, text: str) -> None:
        """Add a note for the user."""
        self._notes.setdefault(text)

    def topics(self) -> Mapping[str, TopicStatus]:
        """Statistics of each topic, by topic."""
        return {topic: meter.status() for topic, meter in sorted(self._meters.items())}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user so far, one sentence each."""
        newest = max((meter.last_ns for meter in self._meters.values()), default=0)
        gaps = [
            f"{topic}: no message for {(newest - meter.last_ns) * 1e-9:.0f} s"
            for topic, meter in sorted(self._meters.items())
            if meter.is_regular and newest - meter.last_ns > _SILENT_NS
        ]
        return (*self._notes, *self._clocks.notes, *gaps)


TYPED_SIGMAS = (0.5, 0.5, 0.26)
"""Standard deviations [m, m, rad] of a pose that a person gives without any, as RViz has it for a click on the map."""


def begun_at(config: Config, pose: Sequence[float], where: str) -> Config:
    """Configuration of a run that begins at a pose that a person typed.

    Args:
        config: keeps its ``initial_sigmas`` if it gives some.
        pose: x, y [m] and yaw [rad] in the map.
        where: name of the option, for errors.

    Raises:
        ConfigError: no such pose.
    """
    as_given = config.estimator.model_dump()
    if "initial_sigmas" not in config.estimator.model_fields_set:
        as_given["initial_sigmas"] = TYPED_SIGMAS
    try:
        estimator = EstimatorConfig.model_validate(as_given | {"initial_pose": tuple(pose)})
    except ValidationError as error:
        why = "; ".join(dict.fromkeys(e["msg"] for e in error.errors()))
        raise ConfigError(
            f"{where} {', '.join(f'{value:g}' for value in pose)}: {why}; expected x, y [m] and yaw [rad]"
        ) from None
    return config.model_copy(update={"estimator": estimator})


def _of_type(name: str, value: Any, kinds: type | tuple[type, ...], expected: str) -> None:
    """Raise the error that names an argument of another type."""
    if not isinstance(value, kinds):
        raise ConfigError(f"Live: {name} is {reprlib.repr(value)}; expected {expected}")


class Live(registry.SensorInput):
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
            ConfigError: an argument of another type, or a role that there is not.
            MapError, ModelError: as their loaders have it.
        """
        _of_type("config", config, Config, "a Config, such as load_config(Path('robot.yaml'))")
        _of_type("landmark_map", landmark_map, (LandmarkMap, Path, type(None)), "a LandmarkMap, or a Path")
        _of_type("state", state, (Path, type(None)), "a Path")
        if isinstance(roles, str):
            raise ConfigError(f"Live: roles is {roles!r}; expected several, such as [{roles!r}]")
        for role in roles or ():
            try:
                known_role(role)
            except ValueError as error:
                raise ConfigError(f"roles: {role!r}: {error}") from None
        if isinstance(landmark_map, Path):
            landmark_map = configured_map(landmark_map, config)
        learned_motion(config, None)  # refuses a file now, not when the robot drives
        self._config, self._recording = config, config.recording
        self._beside = config.recording.beside
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
        """Push an event, in order of receipt; never waits for estimation or detection.

        Args:
            event: any that a recording has.
            publisher: tells publishers of one topic apart; only the first is used, until it has sent nothing for 1 s.

        Returns:
            What is used from now on: mostly the event itself; with a corrected stamp if the topic's clock was reset;
            nothing if it is of a second publisher, or held back for a moment because its clock may have been reset.

        Raises:
            EstimatorError: `close` was called, or it is no event, or one whose stamps are no whole nanoseconds.
            FglocError: the run has failed: what it was fed cannot be used.
        """
        if not isinstance(event, Event):
            raise EstimatorError(
                f"push: {reprlib.repr(event)}; expected an event of fgloc, as its methods odometry, imu, ... make it"
            )
        for stamp in (event.stamp_ns, event.received_ns):
            if not isinstance(stamp, int | np.integer):
                raise EstimatorError(f"push: {type(event).__name__} has stamp {stamp!r}; {WHOLE_NS}")
        with self._lock:
            used = self._reception.receive(event, publisher)
            for received in used:
                motion = self._reception.motion(received)
                if motion is not None:
                    self._results.poses.add(motion)
            self._estimation.put(used)
        return tuple(used)

    def reset_pose(self, pose: Sequence[float], sigmas: Sequence[float] = TYPED_SIGMAS) -> None:
        """Go on from a given pose: x, y [m], yaw [rad] in the map, and their sigmas.

        Sightings that contradict it win: the robot is then found again on the map.

        Raises:
            EstimatorError: values that are none, or the run is closed.
        """
        try:
            mean, spread = np.asarray(pose, dtype=float), np.asarray(sigmas, dtype=float)
        except (TypeError, ValueError):
            mean = spread = np.zeros(0)
        if not (mean.shape == spread.shape == (3,) and np.isfinite([mean, spread]).all() and (spread > 0.0).all()):
            raise EstimatorError(
                f"reset_pose: {pose} with sigmas {sigmas}; expected three finite values and sigmas above 0"
            )
        self._estimation.reset_pose(PoseWithCovariance(mean, np.diag(spread**2)))

    def search(self) -> None:
        """Forget the pose and search for it on the map; what is known of the robot (installation, biases) is kept.

        Raises:
            FglocError: the run has failed or is closed.
        """
        self._estimation.begin_again(Keep.INSTALLATION)

    def reset(self) -> None:
        """Begin anew, as at the start; frames and calibration that have come in are known.

        Raises:
            FglocError: the run has failed or is closed.
        """
        self._estimation.begin_again(Keep.NOTHING)

    def load(self, path: Path) -> None:
        """Go on from a state that `save` wrote, perhaps in an earlier run on the same map.

        Raises:
            EstimatorError: no such file, it is damaged, or of another map; the run goes on as it was.
        """
        self._estimation.begin_again(Keep.NOTHING, path)

    def use_map(self, landmark_map: LandmarkMap | Path) -> None:
        """Go on with another map, or with the file of the map after a change, from the same pose and installation.

        Raises:
            MapError: as its loader has it; the run goes on as it was.
        """
        if isinstance(landmark_map, Path):
            landmark_map = configured_map(landmark_map, self._config)
        self._estimation.begin_again(Keep.ALL, landmark_map)

    def subscribe(self, callback: Callable[[Estimate], None]) -> None:
        """Call a function with every keyframe's estimate, in the thread that has it: it should be quick.

        One that raises is not called again; `status` says so.
        """
        self._results.subscribe(callback)

    # --- events from plain numbers: topics have the names that the configuration gives them, else of their roles ---

    def camera_info(
        self,
        width: int,
        height: int,
        K: ArrayLike,
        D: ArrayLike = (),
        model: str = "plumb_bob",
        frame_id: str = SENSOR,
    ) -> None:
        """Push the camera's calibration, once: K ``(3, 3)`` and D ``(n,)``; see `fgloc.types.Camera` for the models."""
        now = time.time_ns()
        square = np.reshape(K, (3, 3)) if np.size(K) == 9 else K
        arrays = _numbers("K", square, "camera_info"), _numbers("D", np.ravel(D), "camera_info")
        topic = self._recording.topics.camera_info or "camera_info"
        self._deliver(CameraInfoEvent(now, now, topic, frame_id, width, height, model, *arrays))

    def transform(self, parent: str, child: str, translation: ArrayLike, rotation: ArrayLike) -> None:
        """Push a fixed transform ``T_parent_child``: translation ``(3,)`` [m] and quaternion ``(4,)`` x, y, z, w."""
        now = time.time_ns()
        t, q = _numbers("translation", translation, "transform"), _numbers("rotation", rotation, "transform")
        self._deliver(TransformEvent(now, now, "/tf_static", parent, child, t, q, True))

    def _when(self, role: Role, stamp_ns: int) -> When:
        """Stamp as the configuration corrects it, receive time and topic."""
        received = time.time_ns()
        stamp = received if role in self._recording.received_stamps else whole_ns(stamp_ns, EstimatorError)
        given = self._beside.get(role) or self._recording.topics.given(role)
        return stamp + round(self._recording.stamp_offset_s.get(role, 0.0) * 1e9), received, given or role

    def _deliver(self, event: Event) -> None:
        self.push(event)

    # --- out ---

    def pose_at(self, stamp_ns: int | None = None) -> LivePose | None:
        """The pose at a time, propagated from the last keyframe before it by the motion sources.

        Args:
            stamp_ns: up to 5 s back; None: the newest that is known.

        Returns:
            None while no pose is known, or for a time of which nothing is known.

        Raises:
            EstimatorError: the time is no whole number of nanoseconds.
            FglocError: the run has failed.
        """
        self._estimation.check_failed()
        return self._results.poses.pose_at(None if stamp_ns is None else whole_ns(stamp_ns, EstimatorError))

    def status(self) -> LiveStatus:
        """State of the run."""
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


for _name, _method in inspect.getmembers(registry.SensorInput, inspect.isfunction):
    if not _name.startswith("_"):
        setattr(Live, _name, _explained(_method))


def _begun(process: bool | EstimationProcess, settings: Settings, results: _Results) -> Estimation | EstimationProcess:
    if process is False:
        return Estimation(settings, results)
    other = EstimationProcess() if process is True else process
    other.begin(settings, results)
    return other


class _Results:
    """Results of the estimation: poses at any time, and callbacks.

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
        """Notes for the user, one sentence each."""
        with self._lock:
            return tuple(self._notes)

    def subscribe(self, callback: Callable[[Estimate], None]) -> None:
        with self._lock:
            self._subscribers.append(callback)

    def built(self, parts: MotionParts) -> None:
        self.poses.begin(parts)

    def failed(self, error: FglocError) -> None:
        """Do nothing: the next call raises the error."""

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
