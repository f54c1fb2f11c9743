"""Network of a live run by rclpy: the node's topics, its clock, and messages as bytes or as rclpy has them."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosidl_runtime_py import set_message_fields
from rosidl_runtime_py.utilities import get_message

from fgloc.errors import WireError
from fgloc.live.wire.outputs import Outputs
from fgloc.live.wire.transport import Publication, in_order, read_depth, received_ns
from fgloc.recording.messages import Messages
from fgloc.recording.reader import TF_TYPES

_CREATE_S = 0.05  # time between two looks for subscriptions to be made, in the thread of the executor
_SENT_DEPTH = 20  # messages of a topic that wait for readers
_LATCHED_DEPTH = 100
_DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


@dataclass(frozen=True, slots=True, eq=False)
class Heard:
    """One message as rclpy delivers it: serialized, and the types that read it; else without them."""

    topic: str
    message_type: str
    message: Any
    source_ns: int
    messages: Messages | None = None
    publisher: str = ""  # rclpy does not say who


class _Reader:
    """Subscription of one topic, with the function that its messages are handed to.

    Attributes:
        depth: number of messages that may wait in it.
        subscription: rclpy's.
    """

    def __init__(
        self, topic: str, message_type: str, on_message: Callable[[Any], None], messages: Messages | None, depth: int
    ) -> None:
        self._topic, self._type, self._messages = topic, message_type, messages
        self._on_message = on_message
        self.depth = depth
        self.subscription: Any = None

    def heard(self, message: Any, info: Mapping[str, int]) -> tuple[int, tuple[Heard, Callable[[Any], None]]]:
        """One message as rclpy has it, with its time of writing; 0: the middleware does not say."""
        stamp = info["source_timestamp"]
        source_ns = stamp or time.time_ns()
        return stamp, (Heard(self._topic, self._type, message, source_ns, self._messages), self._on_message)

    def take(self, most: int) -> Iterator[tuple[int, tuple[Heard, Callable[[Any], None]]]]:
        """Messages that wait, as rclpy's executor takes them one by one."""
        one = self.subscription
        with one.handle:
            for _ in range(most):
                taken = one.handle.take_message(one.msg_type, one.raw)
                if taken is None:
                    return
                yield self.heard(*taken)


class _NodeClock:
    """Clock of a node: simulated where ``use_sim_time`` is set."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def now_ns(self) -> int:
        return int(self._clock.now().nanoseconds)

    def received_ns(self, message: Any) -> int:
        return received_ns(message.source_ns, self.now_ns(), bool(self._clock.ros_time_is_active))


class _Publisher:
    """Publisher of one topic."""

    def __init__(self, publisher: Any, message_type: str) -> None:
        self._publisher = publisher
        self._type = message_type
        self._class = get_message(message_type)

    @property
    def readers(self) -> int:
        return int(self._publisher.get_subscription_count())

    def publish(self, values: Mapping[str, Any]) -> None:
        if self._type == _DIAGNOSTICS:  # a byte is bytes in rclpy
            status = [{**one, "level": bytes([one["level"]])} for one in values["status"]]
            values = {**values, "status": status}
        message = self._class()
        set_message_fields(message, values)
        self._publisher.publish(message)


class RosTransport:
    """A `Transport` on a lifecycle node. Its publishers stay, its subscriptions end by `stop`."""

    def __init__(self, node: LifecycleNode, map_frame: str, named: Collection[str] = ()) -> None:
        """Make the publishers.

        Args:
            node: not yet active.
            map_frame: transforms from it are of localizers, and no input.
            named: topics that are used also if they are outside of the node's namespace.
        """
        self._node, self._map_frame = node, map_frame
        self._named = {*named, self.full_name("/tf"), self.full_name("/tf_static")}
        self._publishers: dict[str, tuple[Any, _Publisher]] = {}
        self._wanted: list[tuple[str, str, Callable[[Any], None], bool]] = []
        self._readers: list[_Reader] = []
        self._ending: list[_Reader] = []
        self._failure: Exception | None = None
        self._unreadable: set[str] = set()  # topics that were named for that
        self._lost: Counter[str] = Counter()  # messages, by topic
        self._messages = Messages()
        self._lock = threading.Lock()
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # also while simulation time stands still
        self._timer = node.create_timer(_CREATE_S, self._subscribe, clock=steady)
        for topic, kind in Outputs.TYPES.items():
            self.writer(self.full_name(topic), kind, topic in Outputs.LATCHED)

    def stop(self) -> None:
        """End the subscriptions; call it in the executor's thread."""
        self.forget()
        self._end()

    def _end(self) -> None:
        with self._lock:
            ending, self._ending = self._ending, []
        for reader in ending:
            self._node.destroy_subscription(reader.subscription)

    def forget(self) -> None:
        """Let the subscriptions end soon; may be called in any thread."""
        with self._lock:
            self._wanted.clear()
            self._ending, self._readers = [*self._ending, *self._readers], []

    def close(self) -> None:
        """End everything."""
        self.stop()
        self._node.destroy_timer(self._timer)
        for publisher, _ in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._publishers.clear()

    # --- the transport ---

    def full_name(self, name: str) -> str:
        """Full name of a topic, after remapping; see `Transport.full_name`."""
        if name == "~/":
            return f"{self._node.get_fully_qualified_name()}/"
        return str(self._node.resolve_topic_name(name))

    def clock(self) -> _NodeClock:
        """Clock of the node."""
        return _NodeClock(self._node.get_clock())

    def publications(self) -> tuple[Publication, ...]:
        """Topics with publishers in the node's namespace, with those that it names, and /tf.

        Raises:
            WireError: a message of a topic that is read could not be taken in.
        """
        failure, self._failure = self._failure, None
        if failure is not None:
            raise WireError(f"a message could not be taken in: {failure!r}") from failure
        space = self._node.get_namespace().rstrip("/") + "/"
        own = self.full_name("~/")
        found = set()
        for topic, kinds in self._node.get_topic_names_and_types():
            used = topic.startswith(space) or topic in self._named
            used = used and not topic.startswith(own) and len(kinds) == 1 and self._has_others(topic)
            if used and self._is_readable(topic, kinds[0]):
                found.add(Publication(topic, kinds[0]))
        return tuple(sorted(found, key=lambda p: (p.topic, p.message_type)))

    def _is_readable(self, topic: str, message_type: str) -> bool:
        """Whether the messages of a topic are installed; one that fgloc would read is named once in the log if not."""
        try:
            get_message(message_type)
        except Exception as error:  # whatever the import of its package leads to
            if topic not in self._unreadable and self._messages.type_hash(message_type):
                self._unreadable.add(topic)
                self._node.get_logger().error(f"{topic} ({message_type}) cannot be read: {error}; install its package")
            return False
        return True

    def _has_others(self, topic: str) -> bool:
        return int(self._node.count_publishers(topic)) > (topic in self._publishers)

    def has_volatile(self, topic: str) -> bool:
        """Whether one of the topic's publishers keeps nothing for late readers."""
        infos = self._node.get_publishers_info_by_topic(topic)
        return any(info.qos_profile.durability is DurabilityPolicy.VOLATILE for info in infos)

    def lost(self) -> Mapping[str, int]:
        """Messages that were lost on their way here, by topic, as far as the middleware tells."""
        with self._lock:
            return dict(self._lost)

    def read(self, topic: str, message_type: str, on_message: Callable[[Any], None], latched: bool = False) -> None:
        """Deliver a topic's messages from now on, in the executor's thread; it also makes the subscription."""
        with self._lock:
            self._wanted.append((topic, message_type, on_message, latched))

    def decode(self, heard: Heard) -> Any:
        """Content of a message; transforms from the map are left out, for they are of localizers, as this is.

        Raises whatever damaged bytes lead to.
        """
        message = heard.message
        if heard.messages is not None:
            message = heard.messages.decode(heard.message_type, message)
        if heard.message_type in TF_TYPES:
            message.transforms = [t for t in message.transforms if t.header.frame_id.lstrip("/") != self._map_frame]
        return message

    def writer(self, topic: str, message_type: str, latched: bool = False) -> _Publisher:
        """Publisher of a topic, made once; it publishes while the node is active."""
        if topic not in self._publishers:
            made = self._node.create_lifecycle_publisher(
                get_message(message_type),
                topic,
                _profile(1 if latched else _SENT_DEPTH, ReliabilityPolicy.RELIABLE, latched),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            self._publishers[topic] = made, _Publisher(made, message_type)
        return self._publishers[topic][1]

    # --- the executor's thread ---

    def _subscribe(self) -> None:
        self._end()
        with self._lock:
            wanted, self._wanted = self._wanted, []
        for topic, message_type, on_message, latched in wanted:
            try:
                reader = self._reader(topic, message_type, on_message, latched)
            except Exception as error:  # the parameters of its QoS are none
                self._node.get_logger().error(f"{topic} ({message_type}) cannot be read: {error}")
                continue
            with self._lock:
                self._readers.append(reader)

    def _reader(self, topic: str, message_type: str, on_message: Callable[[Any], None], latched: bool) -> _Reader:
        depth = _LATCHED_DEPTH if latched else read_depth(message_type)
        reliability = ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT
        messages = self._messages_of(topic, message_type)
        reader = _Reader(topic, message_type, on_message, messages, depth)

        def lose(info: Any) -> None:
            with self._lock:
                self._lost[topic] += info.total_count_change

        def deliver(message: Any, info: Mapping[str, int]) -> None:
            self._deliver(reader, message, info)

        reader.subscription = self._node.create_subscription(
            get_message(message_type),
            topic,
            deliver,
            _profile(depth, reliability, latched),
            qos_overriding_options=None if latched else QoSOverridingOptions.with_default_policies(),
            event_callbacks=SubscriptionEventCallbacks(message_lost=lose),
            raw=messages is not None,
        )
        return reader

    def _deliver(self, reader: _Reader, message: Any, info: Mapping[str, int]) -> None:
        """Hand on a message that the executor has taken, and those that wait, in the order of writing.

        The executor takes one message of each topic in turn, whichever is older.
        """
        with self._lock:
            queues = [(one.depth, one.take) for one in self._readers]
        for heard, on_message in in_order(queues, [reader.heard(message, info)]):
            try:
                on_message(heard)
            except Exception as error:  # raised by the next look for topics: the run begins again, the executor goes on
                self._failure = error

    def _messages_of(self, topic: str, message_type: str) -> Messages | None:
        """Types of fgloc's that read a topic's messages; None: it has none like its publishers', rclpy reads them.

        A damaged message is counted by the intake; rclpy raises, or asks for the memory that a damaged length names.
        """
        own = self._messages.type_hash(message_type)
        infos = self._node.get_publishers_info_by_topic(topic)
        said = {str(info.topic_type_hash) for info in infos} - {"INVALID"}  # from before Iron
        if own and said <= {own}:
            return self._messages
        return Messages.of_hash(message_type, said.pop()) if own and len(said) == 1 else None


def _profile(depth: int, reliability: ReliabilityPolicy, latched: bool) -> QoSProfile:
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability, durability=durability)
