"""JointState in and Odometry out, exchanged with Fast DDS: ``python -m benchmarks.live_interop``.

The peer (``benchmarks/fastdds_peer/peer.cpp``) is built with the system's Fast DDS (Debian: ``apt install g++
libfastrtps-dev``); types, names and quality of service are those of ROS 2. Both are on loopback.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.common import Row, main, not_run
from fgloc.live.wire.outputs import BaseState, Outputs
from fgloc.live.wire.participant import Participant, Sample

_SOURCE = Path(__file__).parent / "fastdds_peer" / "peer.cpp"
_RATE_HZ = 100.0
_PATIENCE_S = 20.0  # beyond the time that sending takes
_ID = "live.interop"


def build_peer(folder: Path) -> Path | str:
    """Compile the peer into a folder; its path, or why it cannot be had."""
    if shutil.which("g++") is None:
        return "no g++"
    program = folder / "peer"
    command = ["g++", "-std=c++17", "-O1", "-o", str(program), str(_SOURCE), "-lfastrtps", "-lfastcdr"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return f"the peer does not build (apt install libfastrtps-dev?): {done.stderr.splitlines()[0]}"
    return program


def exchange(peer: Path, count: int, domain: int) -> tuple[int, int]:
    """Send ``count`` messages each way; how many did not come, or came wrong, to us and to the peer."""
    numbers: set[int] = set()

    def on_joints(sample: Sample) -> None:
        message = participant.messages.decode(sample.message_type, sample.cdr)
        k = message.header.stamp.sec
        if message.name == ["left", "right"] and message.position.tolist() == [0.5 * k, -0.5 * k]:
            numbers.add(k)

    with Participant(domain) as participant:
        outputs = Outputs(participant)
        participant.read("/joint_states", "sensor_msgs/msg/JointState", on_joints)
        seconds = count / _RATE_HZ + _PATIENCE_S
        command = [str(peer), str(domain), str(count), str(_RATE_HZ), str(seconds)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        sending = threading.Thread(target=_send, args=(outputs, count))
        sending.start()
        said, _ = process.communicate(timeout=seconds + _PATIENCE_S)
        sending.join()
    came = int(said.split()[0]) if process.returncode == 0 else 0
    return count - len(numbers), count - came


def _send(outputs: Outputs, count: int) -> None:
    """Numbered Odometry, once there is a reader."""
    deadline = time.monotonic() + _PATIENCE_S
    while not outputs.readers("~/odometry") and time.monotonic() < deadline:
        time.sleep(0.01)
    for k in range(count):
        x = 0.5 * k
        state = BaseState(
            k * 1_000_000_000, np.array([x, 0.0, 0.0]), np.diag([1.0, 1.0, x]), np.array([0.0, 0.0, x]), np.eye(3)
        )
        outputs.odometry(state, "base_link")
        time.sleep(1.0 / _RATE_HZ)


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    count = 100 if quick else 1000
    with tempfile.TemporaryDirectory() as folder:
        peer = build_peer(Path(folder))
        if isinstance(peer, str):
            yield from not_run([_ID], peer)
            return
        to_us, to_peer = exchange(peer, count, domain=100 + os.getpid() % 100)
    yield Row(_ID, to_us + to_peer, n=2 * count, unit="messages lost")


if __name__ == "__main__":
    main(measure, __doc__ or "")
