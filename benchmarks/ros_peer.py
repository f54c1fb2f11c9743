"""A peer in a real ROS 2 for the node of ``ros/fgloc_ros``: starts it, plays a recording to it by rclpy, and listens.

A process has one middleware: `ask` runs a job in a process of its own, with the one that is named.
"""

from __future__ import annotations

import importlib.util
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "ros" / "fgloc_ros"
PATIENCE_S = 60.0
_RUN = "from fgloc_ros.node import main; main()"
_QUIET_S = 2.0  # without a pose: all have come
_ANSWER_S = 5.0
_CLOCK_S = 0.01
_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def why_not() -> str:
    """Reason why no ROS 2 can be used here; empty if one can."""
    return "" if importlib.util.find_spec("rclpy") else "no ROS 2 here: rclpy cannot be imported; source its setup.bash"


def middlewares() -> list[str]:
    """Middlewares that are installed."""
    from ament_index_python import get_resources

    return sorted(set(get_resources("rmw_typesupport")) - {"rmw_implementation"})  # that one loads the others


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
    done = subprocess.run(
        command_of(job, **arguments), capture_output=True, text=True, timeout=timeout_s, env=env, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{job} with {middleware} ended with {done.returncode}:\n{done.stderr[-4000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def command_of(job: str, **arguments: Any) -> list[str]:
    """Command line of a process that runs one of the functions of this module."""
    return [sys.executable, "-m", "benchmarks.ros_peer", job, json.dumps(arguments)]


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
        """Label of the present state; asked again, for one that was killed is found for a while and does not answer."""
        from lifecycle_msgs.srv import GetState

        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                found = self._peer.call(GetState, f"{self.name}/get_state", GetState.Request(), _ANSWER_S)
                return str(found.current_state.label)
            except TimeoutError:
                if time.monotonic() > deadline:
                    raise TimeoutError(f"{self.name} does not answer:\n{''.join(self.log)}") from None

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
        told: bool = False,
        stop: threading.Event | None = None,
        on_sent: Callable[[str, bytes], None] | None = None,
    ) -> int:
        """Publish a recording with its timing, and /clock; how many messages.

        Args:
            bag: of ROS 2.
            rate: multiple of the recorded speed.
            namespace: of all topics but /tf and /clock.
            needed: topics that must have a reader before it begins.
            simulated: publish /clock; else messages are stamped as if the recording had begun now.
            told: with ``simulated``: somebody else publishes /clock.
            stop: ends it early.
            on_sent: given the topic and content of each message.
        """
        from fgloc.recording.storage import Storage

        storage, prefix = Storage(bag), f"/{namespace}" if namespace else ""
        kinds = {channel.topic: channel.message_type for channel in storage.channels if channel.count}
        names = {topic: topic if topic.startswith("/tf") and not prefix else prefix + topic for topic in kinds}
        for topic, kind in kinds.items():
            self.publisher(names[topic], kind, latched=topic == "/tf_static")
        clock = self.publisher("/clock", "rosgraph_msgs/msg/Clock") if simulated and not told else None
        start_ns, _ = storage.span_ns
        if clock is not None:
            clock.publish(_clock(start_ns))
        wait_until(lambda: all(self.publishers[prefix + t].get_subscription_count() for t in needed), PATIENCE_S)
        began, told_s, sent = time.monotonic(), -1.0, 0
        later_ns = 0 if simulated else time.time_ns() - start_ns
        for topic, kind, received_ns, raw in storage.messages():
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
            content = bytes(raw) if simulated or "/Bool" in kind or "/TF" in kind else restamped(bytes(raw), later_ns)
            if on_sent is not None:
                on_sent(topic, content)
            self.publishers[names[topic]].publish(content)
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
    beside: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """One drive: what was heard of the node, its log and its exit code; ``beside``: further topics, see `announce`."""
    with graph() as peer, announced(beside or {}):
        prefix = f"/{namespace}" if namespace else ""
        heard = peer.hear(f"{prefix}/fgloc/pose", _POSE)
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
            state = node.state()
            node.change(4)  # deactivating ends the run, and so its last keyframe
            settle(heard)
            found = {
                "sent": sent,
                "state": state,
                "poses": poses(heard),
                "odometry": poses(odometry),
                "tf": [[at, t.header.stamp.sec * 10**9 + t.header.stamp.nanosec] for at, t in transforms],
                "frames": sorted({t.child_frame_id for _, t in transforms}),
                "markers": sum(len(m.markers) for _, m in markers),
                "diagnostics": None if status is None else [status.name, status.level[0], status.message],
                "values": (values := {} if status is None else {one.key: one.value for one in status.values}),
                "missed": {k: v for k, v in values.items() if k.startswith(("dropped", "lost")) or ".late" in k},
            }
        finally:
            code = node.end()
        return {**found, "code": code, "log": node.log}


@contextmanager
def announced(topics: Mapping[str, str]) -> Iterator[None]:
    """Topics that a process beside this one publishes, see `announce`."""
    beside = subprocess.Popen(command_of("announce", topics=topics), stdin=subprocess.PIPE) if topics else None
    try:
        yield
    finally:
        if beside is not None:
            beside.kill()
            beside.wait()


def announce(topics: Mapping[str, str]) -> None:
    """Publishers of topics, by a participant of fgloc's: it has message types that are not installed in this ROS."""
    from fgloc.live.wire.participant import Participant

    with Participant(int(os.environ["ROS_DOMAIN_ID"])) as one:
        writers = [one.writer(topic, kind) for topic, kind in topics.items()]
        sys.stdin.read()
        del writers


def failed(parameters: Mapping[str, Any], wrong: Mapping[str, str]) -> dict[str, Any]:
    """Transitions that fail for parameters, one after the other, until all of them are right."""
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    with graph() as peer:
        node = NodeProcess(peer, "", {**parameters, **wrong})
        try:
            steps = [["activate", node.change(3), node.state()]]
            for name in wrong:
                steps.append(["configure", node.change(1), node.state()])
                text = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(parameters.get(name, "")))
                request = SetParameters.Request(parameters=[Parameter(name=name, value=text)])
                peer.call(SetParameters, f"{node.name}/set_parameters", request)
            for name, transition in (("configure", 1), ("activate", 3), ("deactivate", 4), ("clean up", 2)):
                steps.append([name, node.change(transition), node.state()])
                time.sleep(0.5)  # its subscriptions are made by a timer
        finally:
            code = node.end()
        return {"steps": steps, "code": code, "log": node.log}


IMAGES = "/camera/image/compressed"  # of the bundled recordings
INPUTS = (IMAGES, "/camera/camera_info", "/imu", "/odom", "/joint_states")
_KINDS = (
    *("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Imu"),
    *("nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState"),
)
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


def play(
    bag: str, namespace: str = "", simulated: bool = True, told: bool = False, needed: Sequence[str] = INPUTS
) -> dict[str, Any]:
    """Play a recording once, see `Peer.play`; the time of sending of each image, by its stamp, as pairs."""
    images: list[tuple[int, int]] = []

    def on_sent(topic: str, content: bytes) -> None:
        if topic == IMAGES:
            images.append((stamp_of(content), time.time_ns()))

    with graph() as peer:
        sent = peer.play(Path(bag), 1.0, namespace, needed, simulated, told, on_sent=on_sent)
        time.sleep(_QUIET_S)  # what is on its way arrives
    return {"sent": sent, "images": images}


def relay(seconds: float) -> None:
    """A node that does nothing but read the inputs and publish a pose for each image, and one for each odometry."""
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from nav_msgs.msg import Odometry
    from rclpy.qos import qos_profile_sensor_data
    from rosidl_runtime_py.utilities import get_message

    rclpy.init()
    node = rclpy.create_node("relay")
    poses, odometry = (
        node.create_publisher(kind, f"/relay/{name}", 20)
        for kind, name in ((PoseWithCovarianceStamped, "pose"), (Odometry, "odometry"))
    )

    def on_image(message: Any) -> None:
        poses.publish(PoseWithCovarianceStamped(header=message.header))

    for topic, kind in zip(INPUTS, _KINDS, strict=True):
        does = {IMAGES: on_image, "/odom": odometry.publish}.get(topic, lambda message: None)
        node.create_subscription(get_message(kind), topic, does, qos_profile_sensor_data)
    ends = time.monotonic() + seconds
    while rclpy.ok() and time.monotonic() < ends:
        rclpy.spin_once(node, timeout_sec=0.2)


def timed(bag: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """One drive beside a relay, player and listener in processes of their own: times, and shares of a core."""
    with graph() as peer:
        heard = {
            name: (
                peer.hear(f"/{name}/pose", _POSE),
                peer.hear(f"/{name}/odometry", "nav_msgs/msg/Odometry"),
            )
            for name in ("fgloc", "relay")
        }
        beside = subprocess.Popen(command_of("relay", seconds=600.0))
        node = NodeProcess(peer, "", parameters)
        player = None
        try:
            node.start()
            player = subprocess.Popen(command_of("play", bag=bag, simulated=False), stdout=subprocess.PIPE, text=True)
            wait_until(lambda: heard["fgloc"][1], PATIENCE_S)
            pids = {"fgloc": node.process.pid, "relay": beside.pid}
            before = {name: cpu_s(pid) for name, pid in pids.items()}
            began = time.monotonic()
            said, _ = player.communicate()
            over_s = time.monotonic() - began
            shares = {name: (cpu_s(pid) - before[name]) / over_s for name, pid in pids.items()}
        finally:
            beside.kill()
            if player is not None:
                player.kill()
            code = node.end()
        images = dict(json.loads(said.splitlines()[-1])["images"])
        latencies, gaps = {}, {}
        for name, (of_keyframes, at_rate) in heard.items():
            rows = [(row[0], row[1]) for row in poses(of_keyframes)]
            latencies[name] = [(at - images[stamp]) * 1e-6 for at, stamp in rows if stamp in images]
            at_ns = [at for at, _ in at_rate]
            gaps[name] = [(after - at) * 1e-6 for at, after in pairwise(at_ns)]
        return {
            "latencies": latencies,
            "gaps": gaps,
            "shares": shares,
            "code": code,
            "images": len(images),
            "log": node.log,
        }


def two(bags: Sequence[str], parameters: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Two robots in namespaces, at the same time in one domain: poses and subscriptions of both, by name."""
    names = ("one", "two")
    own_tf = ("-r", "/tf:=tf", "-r", "/tf_static:=tf_static")
    with graph() as peer:
        heard = {name: peer.hear(f"/{name}/fgloc/pose", _POSE) for name in names}
        frames = {name: peer.hear(f"/{name}/tf", "tf2_msgs/msg/TFMessage") for name in names}
        shared = peer.hear("/tf", "tf2_msgs/msg/TFMessage")
        diagnostics = peer.hear("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        given = zip(names, parameters, strict=True)
        nodes = {name: NodeProcess(peer, name, {**p, "use_sim_time": True}, *own_tf) for name, p in given}
        players = []
        try:
            for node in nodes.values():
                node.start()
            for name, bag in zip(names, bags, strict=True):  # both recordings begin at the same time: one clock
                command = command_of("play", bag=bag, namespace=name, told=name != names[0])
                players.append(subprocess.Popen(command, stdout=subprocess.DEVNULL))
            for player in players:
                player.wait()
            for name in names:
                settle(heard[name])
                nodes[name].change(4)  # deactivating ends the run, and so its last keyframe
                settle(heard[name])
            reads = {name: peer.node.get_subscriber_names_and_types_by_node("fgloc", f"/{name}") for name in names}
        finally:
            for player in players:
                player.kill()
            codes = {name: node.end() for name, node in nodes.items()}
        return {
            name: {
                "poses": poses(heard[name]),
                "reads": [topic for topic, _ in reads[name]],
                "tf": len(frames[name]),
                "shared_tf": len(shared),
                "dropped": dropped(diagnostics, f"{name}/fgloc"),
                "code": codes[name],
                "log": nodes[name].log,
            }
            for name in names
        }


def dropped(heard: Sequence[tuple[int, Any]], name: str) -> dict[str, str]:
    """Messages that a node has dropped, by its last diagnostics."""
    states = [status for _, message in heard for status in message.status if status.name.startswith(f"{name}:")]
    return {one.key: one.value for one in (states[-1].values if states else ()) if one.key.startswith("dropped")}


def lifecycle(bag: str, parameters: Mapping[str, Any], count: int, seed: int) -> dict[str, Any]:
    """Random transitions and kills while a recording is played again and again.

    Half of them are transitions of one process, so that what it keeps adds up; of the others each eighth is a kill.
    """
    draw = random.Random(seed)
    crashes: list[str] = []
    memory_mb: list[float] = []
    refused = kills = orphans = 0
    player = None
    with graph() as peer:
        node = NodeProcess(peer, "", {**parameters, "use_sim_time": True})
        try:
            for k in range(count):
                if player is None or player.poll() is not None:
                    player = subprocess.Popen(command_of("play", bag=bag, needed=[]), stdout=subprocess.DEVNULL)
                if k >= count // 2 and draw.random() < 0.125:
                    kills += 1
                    children = descendants(node.process.pid)
                    node.process.kill()
                    node.end()
                    orphans += not wait_until(lambda: not any(map(alive, children)), 10.0)  # noqa: B023
                    node = NodeProcess(peer, "", {**parameters, "use_sim_time": True})
                    continue
                state = node.state()
                allowed = _TRANSITIONS[state]
                transition = draw.choice(allowed if draw.random() < 0.8 else sorted(_ALL - {*allowed, *_SHUTDOWNS}))
                done = node.change(transition)
                refused += not done
                if done != (transition in allowed):
                    crashes.append(f"{state}: transition {transition} {'done' if done else 'refused'}")
                time.sleep(draw.choice((0.0, 0.05, 0.5, 2.0)))
                if node.process.poll() is not None:
                    crashes.append(f"ended with {node.process.returncode}: {''.join(node.log[-20:])}")
                    node = NodeProcess(peer, "", {**parameters, "use_sim_time": True})
                elif state == "unconfigured" and k < count // 2:
                    memory_mb.append(memory_of(node.process.pid))
        finally:
            if player is not None:
                player.kill()
            code = node.end()
    return {
        "crashes": crashes,
        "refused": refused,
        "kills": kills,
        "orphans": orphans,
        "memory_mb": memory_mb,
        "code": code,
        "log": node.log[-50:],
    }


def damaged(bag: str, parameters: Mapping[str, Any], count: int, seed: int) -> dict[str, Any]:
    """Messages of random bytes on all topics that the node reads, by their own publishers, during a drive."""
    kinds = {
        **dict(zip(INPUTS, _KINDS, strict=True)),
        "/tf": "tf2_msgs/msg/TFMessage",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/initialpose": _POSE,
        "/clock": "rosgraph_msgs/msg/Clock",
    }
    draw, stop = random.Random(seed), threading.Event()
    with graph() as peer:
        heard = peer.hear("/fgloc/odometry", "nav_msgs/msg/Odometry")
        node = NodeProcess(peer, "", {**parameters, "use_sim_time": True})
        playing = threading.Thread(target=lambda: peer.play(Path(bag), needed=INPUTS, stop=stop))
        try:
            node.start()
            playing.start()
            wait_until(lambda: heard, PATIENCE_S)
            before_mb, sent = memory_of(node.process.pid), 0
            while sent < count and node.process.poll() is None:
                topic = draw.choice(list(kinds))
                size = draw.choice((0, 3) if topic == "/clock" else (0, 3, 20, 80, 800))  # 8 bytes are a time
                content = b"\0\1\0\0" + draw.randbytes(size)
                peer.publisher(topic, kinds[topic], latched=topic == "/tf_static").publish(content)
                sent += 1
                time.sleep(0.002)
            code, already = node.process.poll(), len(heard)
            time.sleep(2.0)
            return {
                "sent": sent,
                "code": code,
                "heard": len(heard) - already,
                "memory_mb": memory_of(node.process.pid) - before_mb if code is None else None,
                "log": node.log[-20:],
            }
        finally:
            stop.set()
            playing.join()
            node.end()


def waiting(count: int) -> list[int]:
    """Numbers of messages of several topics that wait while the executor does something else, as they are handed on.

    They are numbered as they are published: images, odometry and an IMU, of other rates.
    """
    import rclpy
    from fgloc_ros.transport import RosTransport
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.lifecycle import LifecycleNode
    from rosidl_runtime_py.utilities import get_message

    rclpy.init()
    node, peer = LifecycleNode("reads"), rclpy.create_node("peer")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    transport = RosTransport(node, "map")
    found: list[int] = []
    kinds = {"/a": "sensor_msgs/msg/Imu", "/b": "nav_msgs/msg/Odometry", "/c": "sensor_msgs/msg/CompressedImage"}
    publishers = {topic: peer.create_publisher(get_message(kind), topic, 1000) for topic, kind in kinds.items()}
    for topic, kind in kinds.items():
        transport.read(topic, kind, lambda heard: found.append(transport.decode(heard).header.stamp.sec))

    def spin_until(condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)

    spin_until(lambda: all(one.get_subscription_count() for one in publishers.values()))
    for k in range(count):
        topic = "/c" if k % 20 == 10 else "/b" if k % 5 == 1 else "/a"
        message = get_message(kinds[topic])()
        message.header.stamp.sec = k
        publishers[topic].publish(message)
        time.sleep(0.001)
    time.sleep(0.5)  # all have arrived
    spin_until(lambda: len(found) == count)
    transport.close()
    rclpy.try_shutdown()
    return found


_TRANSITIONS = {"unconfigured": (1,), "inactive": (2, 3), "active": (4,), "finalized": ()}
_SHUTDOWNS = (5, 6, 7)  # they end what there is to be changed
_ALL = {1, 2, 3, 4, *_SHUTDOWNS}


def descendants(pid: int) -> list[int]:
    """Processes that a process has started, and those that they have."""
    try:
        own = [
            int(child)
            for path in Path(f"/proc/{pid}/task").glob("*/children")
            for child in path.read_text("utf-8").split()
        ]
    except FileNotFoundError:
        return []
    return [*own, *(one for child in own for one in descendants(child))]


def alive(pid: int) -> bool:
    """Whether a process exists and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text("utf-8").rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def cpu_s(pid: int) -> float:
    """Processor time of a process and of those that it has started [s]."""
    texts = (Path(f"/proc/{one}/stat").read_text("utf-8") for one in (pid, *descendants(pid)))
    stats = (text.rpartition(")")[2].split() for text in texts)
    return sum(int(fields[11]) + int(fields[12]) for fields in stats) * TICK_S


def memory_of(pid: int) -> float:
    """Resident memory of a process [MB]."""
    return int(Path(f"/proc/{pid}/statm").read_text("utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE") * 1e-6


def stamp_of(content: bytes) -> int:
    """Stamp [ns] of a message in CDR that begins with a header."""
    return int.from_bytes(content[4:8], "little") * 1_000_000_000 + int.from_bytes(content[8:12], "little")


def restamped(content: bytes, later_ns: int) -> bytes:
    """A message in CDR that begins with a header, with a later stamp."""
    seconds, rest = divmod(stamp_of(content) + later_ns, 1_000_000_000)
    return content[:4] + seconds.to_bytes(4, "little") + rest.to_bytes(4, "little") + content[12:]


def commands(bag: str, parameters: Mapping[str, Any], participant: bool) -> list[dict[str, Any]]:
    """Commands of ROS while the node, or ``fgloc live``, localizes: what each ended with and what it said.

    One that is wrong is asked again. Some are of a bare node in rclpy (``bare``): what is wrong with it too is ROS's.
    """
    ros2 = shutil.which("ros2") or "ros2"
    asked: list[dict[str, Any]] = []
    files = {key: str(parameters[key]) for key in ("config", "map")}
    live = [sys.executable, "-m", "fgloc.cli", "live", *(f for k, v in files.items() for f in (f"--{k}", v))]
    with graph() as peer:
        heard = peer.hear("/fgloc/odometry", "nav_msgs/msg/Odometry")
        node = None if participant else NodeProcess(peer, "", parameters)
        other = subprocess.Popen(live, stdout=subprocess.DEVNULL) if participant else None
        if node is not None:
            node.start()
        stop = threading.Event()
        playing = threading.Thread(target=_play_on, args=(peer, Path(bag), stop), daemon=True)
        playing.start()
        try:
            wait_until(lambda: heard, PATIENCE_S)
            subprocess.run([ros2, "daemon", "start"], capture_output=True, check=False)
            every = [ros2, "topic", "list"]  # until the daemon has found them
            wait_until(lambda: "/fgloc/map" in subprocess.run(every, capture_output=True, text=True).stdout, PATIENCE_S)
            own = _TOPIC_COMMANDS + (() if participant else _NODE_COMMANDS)
            for pair in zip(own, cycle(_BARE_COMMANDS), strict=False):  # by turns, as the machine's load changes
                for bare, (command, expected, seconds) in enumerate(pair):
                    asked.append(_asked_twice([ros2, *command.split()], expected, seconds) | {"bare": bool(bare)})
            asked.append(_asked_twice([*command_of("transform")], "map -> odom", 0.0) | {"bare": False})
        finally:
            stop.set()
            playing.join()
            subprocess.run([ros2, "daemon", "stop"], capture_output=True, check=False)
            if node is not None:
                node.end()
            if other is not None:
                other.send_signal(signal.SIGINT)
                other.wait()
    return asked


def _play_on(peer: Peer, bag: Path, stop: threading.Event) -> None:
    while not stop.is_set():
        peer.play(bag, needed=INPUTS, simulated=False, stop=stop)


_TOPIC_COMMANDS: tuple[tuple[str, str, float], ...] = (  # command, text that is expected, seconds until Ctrl-C
    ("topic list -t", "/fgloc/odometry [nav_msgs/msg/Odometry]", 0.0),
    *((f"topic info -v {topic}", "type hash: RIHS01_", 0.0) for topic in ("/fgloc/odometry", "/fgloc/map", "/tf")),
    ("topic hz /fgloc/odometry", "average rate: ", 8.0),
    ("topic hz /tf", "average rate: ", 8.0),
    ("topic echo --once /fgloc/odometry", "frame_id: map", 0.0),
    ("topic echo --once /fgloc/pose", "frame_id: map", 0.0),
    ("topic echo --once /fgloc/protection", "frame_id: map", 0.0),
    ("topic echo --once /fgloc/map", "ns: ", 0.0),
    ("topic echo --once /diagnostics", "name: 'fgloc: ", 0.0),
    ("topic echo --once --filter True /tf", "frame_id: map", 0.0),
    ("node list", "/peer", 0.0),
)
_NODE_COMMANDS: tuple[tuple[str, str, float], ...] = (
    ("node list", "/fgloc", 0.0),
    ("node info /fgloc", "/fgloc/odometry: nav_msgs/msg/Odometry", 0.0),
    ("param list /fgloc", "transform_tolerance", 0.0),
    ("param get /fgloc rate", "50.0", 0.0),
    ("param describe /fgloc map_frame", "frame of the poses", 0.0),
    ("param set /fgloc transform_tolerance 0.1", "Set parameter successful", 0.0),
    ("param dump /fgloc", "transform_tolerance: 0.1", 0.0),
    ("lifecycle nodes", "/fgloc", 0.0),
    ("lifecycle get /fgloc", "active [3]", 0.0),
    ("lifecycle list /fgloc", "deactivate", 0.0),
    ("service list -t", "/fgloc/global_search [std_srvs/srv/Trigger]", 0.0),
    ("service call /fgloc/save_state std_srvs/srv/Trigger", "success=True", 0.0),
    ("service call /fgloc/global_search std_srvs/srv/Trigger", "success=True", 0.0),
    ("lifecycle set /fgloc deactivate", "Transitioning successful", 0.0),
    ("lifecycle set /fgloc activate", "Transitioning successful", 0.0),
)
_BARE_COMMANDS: tuple[tuple[str, str, float], ...] = (
    ("topic info -v /odom", "type hash: RIHS01_", 0.0),
    ("topic hz /odom", "average rate: ", 8.0),
    ("topic hz /odom", "average rate: ", 8.0),
    ("topic echo --once /odom", "frame_id: ", 0.0),
    ("topic echo --once --filter True /odom", "frame_id: ", 0.0),
    ("node info /peer", "/odom: nav_msgs/msg/Odometry", 0.0),
    ("param list /peer", "use_sim_time", 0.0),
    ("param describe /peer use_sim_time", "Parameter name: use_sim_time", 0.0),
)
_WARNING = re.compile(r"warn|error|fail|traceback|invalid", re.IGNORECASE)


def _asked_twice(command: Sequence[str], expected: str, seconds: float) -> dict[str, Any]:
    """Answer of a command, asked again if it is wrong; what was wrong with the first one is ``first_wrong``."""
    first = _asked(command, expected, seconds)
    return (_asked(command, expected, seconds) if first["wrong"] else first) | {"first_wrong": first["wrong"]}


def _asked(command: Sequence[str], expected: str, seconds: float) -> dict[str, Any]:
    """Answer of one command, ended by Ctrl-C after some seconds if any are given; what is wrong with it."""
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}
    )
    try:
        said, complained = process.communicate(timeout=seconds or PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        said, complained = process.communicate()
    wrong = []
    if expected not in said:
        wrong.append(f"{expected!r} is not in its answer")
    if process.returncode and not seconds:
        wrong.append(f"exit code {process.returncode}")
    if warned := [line for line in (said + complained).splitlines() if _WARNING.search(line)]:
        wrong.append(f"it warns: {warned[0]}")
    return {"command": " ".join(map(str, command[1:])), "wrong": wrong, "said": said[-2000:], "err": complained[-2000:]}


def transform() -> str:
    """The transform from the map to the odometry's frame by tf2, from what there is on /tf and /tf_static."""
    import rclpy
    from tf2_ros import Buffer, TransformListener

    with graph() as peer:
        buffer = Buffer()
        listener = TransformListener(buffer, peer.node)
        newest = rclpy.time.Time()
        found = wait_until(lambda: buffer.can_transform("map", "odom", newest), 20.0)
        p = buffer.lookup_transform("map", "odom", newest).transform.translation if found else None
        del listener
    return "no transform" if p is None else f"map -> odom {p.x:.3f} {p.y:.3f}"


def main() -> None:
    """Run one job."""
    print(json.dumps(globals()[sys.argv[1]](**json.loads(sys.argv[2]))))


if __name__ == "__main__":
    main()
