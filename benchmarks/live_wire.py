"""``fgloc play`` into ``fgloc live``, as two processes on loopback: ``python -m benchmarks.live_wire``.

The bundled recordings, at their own speed. A third process, this one, subscribes to what is published.

- ``live.equal_mm``: largest distance between the poses published and those of ``fgloc online`` on the same recording,
  at common keyframes; ``live.equal_keyframes`` is the share of the latter's keyframes that were published.
- ``live.rate_hz``, ``live.jitter_ms_p99``: of the odometry, by the times of sending: messages a second, and how far the
  time between two messages is from its mean.
- ``live.wire_latency_ms_*``: from the arrival of an image, here, to the sending of the pose of its exposure.
- ``live.cpu_share``: processor time of ``fgloc live``, all of its threads and processes, over the time, of one core.
- ``live.stop_s``: from Ctrl-C to the end of the process.
- ``live.busy_*``: the same with two other processes that compute without end.
- ``live.load``: processes of this machine that ran or wanted to run, mean over the last minute of the unhurried runs:
  more than the machine's cores disturb all of these figures.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common import SAMPLES, Row, main, stamp_of
from benchmarks.ros_peer import cpu_s
from fgloc.config import load_config
from fgloc.live.wire.participant import Participant, Sample
from fgloc.runner import run
from fgloc.types import FloatArray, IntArray

_NAMES = ("first_run", "installed_run")
_PATIENCE_S = 30.0
_IMAGES = "/camera/image/compressed"  # of the bundled recordings
_OTHERS = 2  # processes beside, on a machine of two cores


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """Messages that one run published, and its processor time."""

    stamps_ns: IntArray  # (n,) of the keyframes' poses
    positions: FloatArray  # (n, 2)
    latencies_ms: FloatArray  # (k,) of those at an image
    sent_s: FloatArray  # (m,) times of sending of the odometry
    cpu_share: float
    stop_s: float
    exit_code: int
    said: str


class _Recorder:
    """Poses and odometry of a run, as they come."""

    def __init__(self, participant: Participant) -> None:
        self.poses: list[tuple[int, float, float]] = []
        self.pose_sent_ns: dict[int, int] = {}  # by stamp
        self.images_ns: dict[int, int] = {}  # by stamp: when they came
        self.sent_ns: list[int] = []
        self._messages = participant.messages
        participant.read("/fgloc/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", self._on_pose)
        participant.read(_IMAGES, "sensor_msgs/msg/CompressedImage", self._on_image)
        participant.read(
            "/fgloc/odometry", "nav_msgs/msg/Odometry", lambda sample: self.sent_ns.append(sample.source_ns)
        )

    def _on_pose(self, sample: Sample) -> None:
        message = self._messages.decode(sample.message_type, sample.cdr)
        position, stamp_ns = message.pose.pose.position, stamp_of(message.header)
        self.poses.append((stamp_ns, position.x, position.y))
        self.pose_sent_ns[stamp_ns] = sample.source_ns

    def _on_image(self, sample: Sample) -> None:
        now = time.time_ns()
        self.images_ns[stamp_of(self._messages.decode(sample.message_type, sample.cdr).header)] = now

    @property
    def latencies_ms(self) -> FloatArray:
        """Time [ms] from an image to the pose of its exposure, for each image that has one."""
        both = self.images_ns.keys() & self.pose_sent_ns.keys()
        return np.array([(self.pose_sent_ns[stamp] - self.images_ns[stamp]) * 1e-6 for stamp in sorted(both)])


def live_run(sample: Path, domain: int, rate: float = 1.0) -> Heard:
    """Play a sample into ``fgloc live`` and record what it publishes."""
    command = [sys.executable, "-m", "fgloc.cli"]
    with Participant(domain) as participant:
        recorder = _Recorder(participant)
        files = ["--map", str(sample / "map.yaml"), "--config", str(sample / "robot.yaml")]
        live = subprocess.Popen(
            [*command, "live", "--domain", str(domain), *files],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        play = subprocess.Popen(
            [*command, "play", str(sample / "bag"), "--domain", str(domain), "--rate", str(rate)],
            stdout=subprocess.DEVNULL,
        )
        try:
            cpu_share = _share_while_publishing(live.pid, play, recorder)
            began = time.monotonic()
            live.send_signal(signal.SIGINT)
            said, _ = live.communicate(timeout=_PATIENCE_S)
            stop_s = time.monotonic() - began
        finally:
            live.kill()
            play.kill()
    if len(recorder.sent_ns) < 2:
        raise RuntimeError(f"{sample.name}: fgloc live published nothing (exit code {live.returncode}):\n{said}")
    poses = np.array(sorted(recorder.poses)).reshape(-1, 3)
    stamps = np.array([stamp for stamp, _, _ in sorted(recorder.poses)], dtype=np.int64)
    sent_s = np.array(recorder.sent_ns, dtype=np.int64) * 1e-9
    return Heard(stamps, poses[:, 1:], recorder.latencies_ms, np.sort(sent_s), cpu_share, stop_s, live.returncode, said)


def _share_while_publishing(pid: int, play: subprocess.Popen[bytes], recorder: _Recorder) -> float:
    """Share of a core that a process takes from its first odometry until the player has ended."""
    deadline = time.monotonic() + _PATIENCE_S
    while not recorder.sent_ns and time.monotonic() < deadline:
        time.sleep(0.05)
    began, used = time.monotonic(), cpu_s(pid)
    play.wait()
    return (cpu_s(pid) - used) / (time.monotonic() - began)


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """Other processes that compute without end."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def largest_difference_mm(heard: Heard, sample: Path) -> tuple[float, float]:
    """Largest difference [mm] of published poses from those of an online run, and the share of the latter published."""
    config = load_config(sample / "robot.yaml")
    online = run(sample / "bag", sample / "map.yaml", config, "online").trajectory
    _, published, expected = np.intersect1d(heard.stamps_ns, online.stamps_ns, return_indices=True)
    apart = heard.positions[published] - online.poses[expected, :2]
    return float(np.hypot(*apart.T).max()) * 1e3, len(expected) / len(online)


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    names, rate = (_NAMES[:1], 4.0) if quick else (_NAMES, 1.0)
    runs = [live_run(SAMPLES / name, 100 + (os.getpid() + k) % 100, rate) for k, name in enumerate(names)]
    load = os.getloadavg()[0]
    equal = np.array([largest_difference_mm(heard, SAMPLES / name) for heard, name in zip(runs, names, strict=True)])
    yield Row("live.equal_mm", float(equal[:, 0].max()), n=len(runs), unit="mm")
    yield Row("live.equal_keyframes", float(equal[:, 1].min()), n=len(runs))
    yield from timing("live.", runs)
    yield Row("live.load", load)
    with _busy(_OTHERS):
        yield from timing("live.busy_", [live_run(SAMPLES / names[-1], 100 + (os.getpid() + len(names)) % 100, rate)])


def timing(prefix: str, runs: Sequence[Heard]) -> Iterator[Row]:
    """Rows of the worst of several runs; latencies over all of them."""
    gaps_ms = [np.diff(heard.sent_s) * 1e3 for heard in runs]
    rates = [1e3 / float(gaps.mean()) for gaps in gaps_ms]
    jitters = [float(np.percentile(np.abs(gaps - gaps.mean()), 99)) for gaps in gaps_ms]
    latencies = np.concatenate([heard.latencies_ms for heard in runs])
    n = len(runs)
    yield Row(prefix + "rate_hz", min(rates), n=n, unit="Hz")
    yield Row(prefix + "jitter_ms_p99", max(jitters), n=n, unit="ms")
    for share in (50, 99):
        latency = float(np.percentile(latencies, share))
        yield Row(f"{prefix}wire_latency_ms_p{share}", latency, n=len(latencies), unit="ms")
    yield Row(prefix + "cpu_share", max(heard.cpu_share for heard in runs), n=n)
    yield Row(prefix + "stop_s", max(heard.stop_s for heard in runs), n=n, unit="s")


if __name__ == "__main__":
    main(measure, __doc__ or "")
