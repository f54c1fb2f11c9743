"""A peer in a real ROS 2 for the node of ``ros/fgloc_ros``: starts it, plays a recording to it by rclpy, and listens.

A process has one middleware: `ask` runs a job in a process of its own, with the one that is named.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "ros" / "fgloc_ros"
PATIENCE_S = 60.0
_RUN = "from fgloc_ros.node import main; main()"
_QUIET_S = 2.0  # without a pose: all have come
_CLOCK_S = 0.01


def why_not() -> str:
    """Reason why no ROS 2 can be used here; empty if one can."""
    return "" if importlib.util.find_spec("rclpy") else "no ROS 2 here: rclpy cannot be imported; source its setup.bash"


def middlewares() -> list[str]:
    """Middlewares that are installed."""
    from ament_index_python import get_resources

    return sorted(get_resources("rmw_typesupport"))


def ask(job: str, middleware: str, timeout_s: float = 600.0, **arguments: Any) -> Any:
    """Result of one of the functions of this module, in a process with this middleware.

    Raises:
        RuntimeError: it ended otherwise than with a result.
    """
    env = {
        **os.environ,
        "RMW_IMPLEMENTATION": middleware,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(100 + os.getpid() % 100),
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(PACKAGE), *filter(None, [os.environ.get("PYTHONPATH")])]),
    }
    command = [sys.executable, "-m", "benchmarks.ros_peer", job, json.dumps(arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, env=env, check=False)
    if done.returncode:
        raise RuntimeError(f"{job} with {middleware} ended with {done.returncode}:\n{done.stderr[-4000:]}")
    return json.loads(done.stdout.splitlines()[-1])


class NodeProcess:
    """The node in a process of its own, and its lifecycle.

    Attributes:
        log: what it has written so far.
    """

    def __init__(self, peer: Peer, namespace: str = "", parameters: Mapping[str, Any] | None = None, *arguments: str):
        """Start it."""
        given = [f for name, value in (parameters or {}).items() for f in ("-p", f"{name}:={json.dumps(value)}")]
        command = [sys.executable, "-c", _RUN, "--ros-args", "-r", f"__ns:=/{namespace}", *given, *arguments]
        self._peer = peer
        self.name = f"{'/' + namespace if namespace else ''}/fgloc"
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.log: list[str] = []
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.log.extend(self.process.stdout)

    def change(self, transition: int, timeout_s: float = PATIENCE_S) -> bool:
        """Ask for a transition."""
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request()
        request.transition.id = transition
        return bool(self._peer.call(ChangeState, f"{self.name}/change_state", request, timeout_s).success)

    def state(self) -> str:
        """Label of the present state."""
        from lifecycle_msgs.srv import GetState

        found = self._peer.call(GetState, f"{self.name}/get_state", GetState.Request())
        return str(found.current_state.label)

    def start(self) -> None:
        """Configure and activate."""
        from lifecycle_msgs.msg import Transition

        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            if not self.change(transition):
                raise RuntimeError(f"transition {transition} of {self.name} failed:\n{''.join(self.log)}")

    def trigger(self, service: str) -> tuple[bool, str]:
        """Call one of its services."""
        from std_srvs.srv import Trigger

        done = self._peer.call(Trigger, f"{self.name}/{service}", Trigger.Request())
        return bool(done.success), str(done.message)

    def end(self) -> int:
        """End it by a signal, as a service manager does; its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(2)
        try:
            code = self.process.wait(20.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        self._reading.join(5.0)
        return code


class Peer:
    """A node of rclpy that publishes, listens and calls, with an executor in a thread."""

    def __init__(self) -> None:
        """Join the graph."""
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        rclpy.init()
        self.node = rclpy.create_node("peer")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._spinning = threading.Thread(target=self._spin, daemon=True)
        self._spinning.start()
        self.publishers: dict[str, Any] = {}

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def close(self) -> None:
        """Leave the graph."""
        import rclpy

        rclpy.try_shutdown()
        self._spinning.join(5.0)

    def hear(self, topic: str, message_type: str, latched: bool = False) -> list[tuple[int, Any]]:
        """Messages of a topic from now on, each with the time of its arrival [ns]."""
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from rosidl_runtime_py.utilities import get_message

        heard: list[tuple[int, Any]] = []
        qos = QoSProfile(depth=1000)
        if latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        self.node.create_subscription(
            get_message(message_type), topic, lambda m: heard.append((time.time_ns(), m)), qos
        )
        return heard

    def publisher(self, topic: str, message_type: str, latched: bool = False) -> Any:
        """Publisher of a topic."""
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from rosidl_runtime_py.utilities import get_message

        if topic not in self.publishers:
            qos = QoSProfile(depth=200)
            if latched:
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            self.publishers[topic] = self.node.create_publisher(get_message(message_type), topic, qos)
        return self.publishers[topic]

    def call(self, kind: Any, name: str, request: Any, timeout_s: float = PATIENCE_S) -> Any:
        """Response of a service.

        Raises:
            TimeoutError: it is not there, or does not answer.
        """
        client = self.node.create_client(kind, name)
        try:
            if not client.wait_for_service(timeout_s):
                raise TimeoutError(f"{name} is not there after {timeout_s:g} s")
            answered = threading.Event()
            future = client.call_async(request)
            future.add_done_callback(lambda _: answered.set())
            if not answered.wait(timeout_s):
                raise TimeoutError(f"{name} has not answered for {timeout_s:g} s")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def play(
        self,
        bag: Path,
        rate: float = 1.0,
        namespace: str = "",
        needed: Sequence[str] = (),
        simulated: bool = True,
        stop: threading.Event | None = None,
    ) -> int:
        """Publish a recording with its timing, and /clock; how many messages.

        Args:
            bag: of ROS 2.
            rate: multiple of the recorded speed.
            namespace: of all topics but /tf and /clock.
            needed: topics that must have a reader before it begins.
            simulated: publish /clock.
            stop: ends it early.
        """
        from fgloc.recording.storage import Storage

        storage, prefix = Storage(bag), f"/{namespace}" if namespace else ""
        kinds = {channel.topic: channel.message_type for channel in storage.channels if channel.count}
        names = {topic: topic if topic.startswith("/tf") and not prefix else prefix + topic for topic in kinds}
        for topic, kind in kinds.items():
            self.publisher(names[topic], kind, latched=topic == "/tf_static")
        clock = self.publisher("/clock", "rosgraph_msgs/msg/Clock") if simulated else None
        start_ns, _ = storage.span_ns
        if clock is not None:
            clock.publish(_clock(start_ns))
        wait_until(lambda: all(self.publishers[prefix + t].get_subscription_count() for t in needed), PATIENCE_S)
        began, told_s, sent = time.monotonic(), -1.0, 0
        for topic, _, received_ns, raw in storage.messages():
            due = (received_ns - start_ns) * 1e-9 / rate
            while (now := time.monotonic() - began) < due:
                if clock is not None and now - told_s >= _CLOCK_S:
                    told_s = now
                    clock.publish(_clock(start_ns + round(now * rate * 1e9)))
                time.sleep(min(due - now, 0.005))
            if clock is not None and now - told_s >= _CLOCK_S:
                told_s = now
                clock.publish(_clock(received_ns))
            if stop is not None and stop.is_set():
                break
            self.publishers[names[topic]].publish(bytes(raw))
            sent += 1
        storage.close()
        return sent


def _clock(stamp_ns: int) -> Any:
    from rosgraph_msgs.msg import Clock

    message = Clock()
    message.clock.sec, message.clock.nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return message


def wait_until(condition: Any, timeout_s: float) -> bool:
    """Wait until a condition holds; whether it does."""
    deadline = time.monotonic() + timeout_s
    while not (found := condition()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return bool(found)


def settle(heard: list[Any]) -> None:
    """Wait until no more messages come."""
    before = -1
    while len(heard) > before:
        before = len(heard)
        time.sleep(_QUIET_S)


@contextmanager
def graph() -> Iterator[Peer]:
    """A peer, and its end."""
    peer = Peer()
    try:
        yield peer
    finally:
        peer.close()


# --- jobs -------------------------------------------------------------------------------------------------------------


def poses(heard: Sequence[tuple[int, Any]]) -> list[list[float]]:
    """Arrival [ns], stamp [ns], x, y, yaw of messages with a pose in `pose.pose`."""
    from fgloc.frames import quaternion_yaw

    rows = []
    for at, m in heard:
        p, q = m.pose.pose.position, m.pose.pose.orientation
        stamp = m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec
        rows.append([at, stamp, p.x, p.y, quaternion_yaw((q.x, q.y, q.z, q.w))])
    return rows


def drive(
    bag: str,
    parameters: Mapping[str, Any],
    needed: Sequence[str],
    rate: float = 1.0,
    namespace: str = "",
    simulated: bool = True,
) -> dict[str, Any]:
    """One drive: what was heard of the node, its log and its exit code."""
    with graph() as peer:
        prefix = f"/{namespace}" if namespace else ""
        heard = peer.hear(f"{prefix}/fgloc/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
        odometry = peer.hear(f"{prefix}/fgloc/odometry", "nav_msgs/msg/Odometry")
        tf = peer.hear("/tf", "tf2_msgs/msg/TFMessage")
        diagnostics = peer.hear("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        markers = peer.hear(f"{prefix}/fgloc/map", "visualization_msgs/msg/MarkerArray", latched=True)
        node = NodeProcess(peer, namespace, {**parameters, "use_sim_time": simulated})
        try:
            node.start()
            sent = peer.play(Path(bag), rate, namespace, needed, simulated)
            settle(heard)
            transforms = [(at, t) for at, m in tf for t in m.transforms if t.header.frame_id == "map"]
            wait_until(lambda: bool(diagnostics), 3.0)
            status = diagnostics[-1][1].status[0] if diagnostics else None
            found = {
                "sent": sent,
                "state": node.state(),
                "poses": poses(heard),
                "odometry": poses(odometry),
                "tf": [[at, t.header.stamp.sec * 10**9 + t.header.stamp.nanosec] for at, t in transforms],
                "frames": sorted({t.child_frame_id for _, t in transforms}),
                "markers": sum(len(m.markers) for _, m in markers),
                "diagnostics": None if status is None else [status.name, status.level[0], status.message],
            }
        finally:
            code = node.end()
        return {**found, "code": code, "log": node.log}


def main() -> None:
    """Run one job."""
    print(json.dumps(globals()[sys.argv[1]](**json.loads(sys.argv[2]))))


if __name__ == "__main__":
    main()
