"""A participant on ROS 2's wire: finds publications, writes and reads messages as CDR, and knows what time it is.

cyclonedds is imported late: it comes with the extra ``live``.
"""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

from fgloc.errors import WireError
from fgloc.live.wire.transport import Publication, Received, in_order, read_depth, received_ns
from fgloc.recording.messages import FieldLayout, Messages
from fgloc.recording.reader import OWN

if TYPE_CHECKING:
    from cyclonedds.domain import Domain


# --- Names of topics and types in DDS ---------------------------------------------------------------------------------

_TOPIC = "rt/"
_TYPE_HASH = re.compile(rb"typehash=(RIHS\d\d_[0-9a-f]{64});")


def dds_topic(topic: str) -> str:
    """``/odom`` as ``rt/odom``."""
    return _TOPIC + topic.lstrip("/")


def ros_topic(dds: str) -> str | None:
    """``rt/odom`` as ``/odom``; None: no topic of ROS (a service, an action's part, another program's)."""
    return "/" + dds.removeprefix(_TOPIC) if dds.startswith(_TOPIC) else None


def dds_type(message_type: str) -> str:
    """``nav_msgs/msg/Odometry`` as ``nav_msgs::msg::dds_::Odometry_``."""
    package, kind, name = message_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(dds: str) -> str | None:
    """``nav_msgs::msg::dds_::Odometry_`` as ``nav_msgs/msg/Odometry``; None: no message type of ROS."""
    parts = dds.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return None
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


# --- DDS types, built from message definitions; rosbags (de)serializes what goes through them -------------------------


def cdr_type(message_type: str, layout: Mapping[str, Sequence[FieldLayout]]) -> type[Any]:
    """A topic type of cyclonedds whose samples are made of, and hold, a message's CDR as ``cdr``.

    DDS gets the true type, so that others can check against it what they exchange with us, and damaged samples are
    dropped on arrival; cyclonedds' own (de)serialization in Python, which is slow, is left out.

    Args:
        message_type: "pkg/msg/Name".
        layout: fields of it and of all the types inside it, by type.

    Raises:
        WireError: a field is of a kind that DDS lacks.
    """
    made: dict[str, type[Any]] = {}
    kind = _struct(message_type, layout, made)

    def init(self: Any, cdr: bytes) -> None:
        self.cdr = cdr

    def serialize(self: Any, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None) -> bytes:
        return bytes(self.cdr)

    def deserialize(cls: Any, data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> Any:
        return cls(data)

    kind.__init__ = init
    kind.serialize = serialize
    kind.deserialize = kind.deserialize_key = classmethod(deserialize)  # a key comes alone when a writer leaves
    return kind


def _struct(name: str, layout: Mapping[str, Sequence[FieldLayout]], made: dict[str, type[Any]]) -> type[Any]:
    from cyclonedds.idl import make_idl_struct

    if name not in made:
        fields = {field.name: _field(field, layout, made) for field in layout[name]}
        typename = dds_type(name).replace("::", ".")  # cyclonedds' spelling
        made[name] = make_idl_struct(name.rsplit("/", 1)[-1] + "_", typename, fields)
    return made[name]


def _field(field: FieldLayout, layout: Mapping[str, Sequence[FieldLayout]], made: dict[str, type[Any]]) -> Any:
    from cyclonedds.idl import types

    plain = {"string": str, "bool": bool, "char": types.uint8}
    inner: Any
    if field.nested:
        inner = _struct(field.element, layout, made)
    else:
        inner = plain.get(field.element) or getattr(types, field.element, None)
        if inner is None:
            raise WireError(f"field {field.name} is a {field.element}, which cannot be put on the wire; leave it out")
    if field.array is not None:
        return types.array[inner, field.array]
    if field.sequence is not None:
        return types.sequence[inner]  # bounds do not change the CDR
    return inner


# --- Participant ------------------------------------------------------------------------------------------------------

_LOOPBACK = """<CycloneDDS><Domain>
<General><Interfaces><NetworkInterface address="127.0.0.1" multicast="true"/></Interfaces>
<AllowMulticast>spdp</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
"""As ROS 2 does where it is set to stay on one machine (32: its rmw's limit of processes that find one another)."""

_SENT_DEPTH = 200  # messages of a topic that wait for readers: 1 s of a fast sensor
_LATCHED_DEPTH = 100  # messages of a topic that late readers get: each static transform may be one
_BLOCK_S = 1.0  # a writer waits this long for a reader that has no more room
_WAIT_S = 60.0  # the reading thread waits this long for messages, then again

_domains: WeakValueDictionary[int, Domain] = WeakValueDictionary()
_domains_lock = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One message as it was received."""

    topic: str
    message_type: str
    cdr: bytes
    source_ns: int  # when it was written, by its writer's clock
    publisher: str = ""  # its writer: another one has another name, also on the same topic


OnSample = Callable[[Sample], None]


@dataclass(frozen=True, slots=True, eq=False)
class _Reader:
    """Reader of one topic, with the function that its messages are delivered to."""

    reader: Any
    unread: Any  # the condition that it has unread messages
    publication: Publication
    on_sample: OnSample

    @property
    def depth(self) -> int:
        """Number of messages that may wait in it."""
        return read_depth(self.publication.message_type)

    def take(self, most: int) -> Iterator[tuple[int, tuple[Sample, OnSample]]]:
        """Messages that wait, each with its time of writing."""
        topic, message_type = self.publication.topic, self.publication.message_type
        for message in self.reader.take(most):
            info = message.sample_info
            if info.valid_data:
                source_ns, publisher = info.source_timestamp, str(info.publication_handle)  # stands for a GUID
                yield source_ns, (Sample(topic, message_type, message.cdr, source_ns, publisher), self.on_sample)


class Writer:
    """Publishes messages on one topic."""

    def __init__(
        self, writer: Any, kind: type[Any], encode: Callable[[Mapping[str, Any]], bytes] | None = None
    ) -> None:
        self._writer = writer
        self._kind = kind
        self._encode = encode

    def publish(self, values: Mapping[str, Any]) -> None:
        """Send a message, given as `Messages.encode` has it."""
        assert self._encode is not None
        self.write(self._encode(values))

    def write(self, cdr: bytes, source_ns: int | None = None) -> None:
        """Send one message; ``source_ns``: the time that readers see as that of writing; None: now."""
        self._writer.write(self._kind(cdr), timestamp=source_ns)

    @property
    def readers(self) -> int:
        """Number of matched readers."""
        return len(self._writer.get_matched_subscriptions())

    def flush(self, timeout_s: float) -> None:
        """Wait until all reliable readers have acknowledged everything."""
        try:
            self._writer.wait_for_acks(round(timeout_s * 1e9))
        except Exception:  # cyclonedds 11.0.1 raises AttributeError where it means a timeout
            return


class Participant:
    """A DDS participant. Close it, or use it in a ``with``."""

    def __init__(self, domain: int = 0, network: bool = False, messages: Messages | None = None) -> None:
        """Join a domain.

        Args:
            domain: as ROS_DOMAIN_ID.
            network: on all the machine's networks, or as CYCLONEDDS_URI has it; else only on loopback.
            messages: message types; None: ROS 2 Humble's.

        Raises:
            WireError: cyclonedds is not installed, or there is no such domain.
        """
        if not 0 <= domain <= 232:
            raise WireError(f"domain {domain}: expected 0 to 232, as ROS_DOMAIN_ID")
        try:
            from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
            from cyclonedds.core import DDSException, GuardCondition, WaitSet
            from cyclonedds.domain import DomainParticipant
        except ImportError as error:
            raise WireError(f"cyclonedds cannot be loaded ({error}); install it: pip install 'fgloc[live]'") from error
        self.messages = Messages() if messages is None else messages
        try:
            self._domain = None if network else _loopback(domain)
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise WireError(f"DDS does not start in domain {domain}: {error.msg}") from error
        self._found = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._publications: dict[object, Publication] = {}
        self._volatile: set[str] = set()
        self._topics: dict[str, Any] = {}
        self._hashes: dict[str, str] = {}  # of the type that others write, by topic, where they say it
        self._types: dict[str, Messages] = {}  # of the topics that are read
        self._readers: list[_Reader] = []
        self._entering: list[_Reader] = []
        self._failure: Exception | None = None
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._changed = GuardCondition(self._participant)
        self._waiting = WaitSet(self._participant)
        self._waiting.attach(self._changed)
        self._thread = threading.Thread(target=self._read, name="fgloc-wire", daemon=True)
        self._thread.start()

    def __enter__(self) -> Participant:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the domain. Nothing is delivered afterwards."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._changed.set(True)
        self._thread.join()
        self._readers.clear()
        self._entering.clear()
        self._topics.clear()
        del self._waiting, self._changed, self._found, self._participant, self._domain

    def full_name(self, name: str) -> str:
        """Full name of a topic; see `Transport.full_name`."""
        return OWN + name[2:] if name.startswith("~/") else "/" + name.lstrip("/")

    def clock(self) -> WireClock:
        """Clock of the wire."""
        return WireClock(self)

    def decode(self, sample: Sample) -> Any:
        """Content of a message. Raises whatever rosbags leaks on damaged bytes."""
        return self._types.get(sample.topic, self.messages).decode(sample.message_type, sample.cdr)

    def publications(self) -> tuple[Publication, ...]:
        """Topics that others publish now, sorted by name.

        Raises:
            WireError: a message of a topic that is read could not be taken in.
        """
        if self._failure is not None:
            raise WireError(f"a message could not be taken in: {self._failure!r}") from self._failure
        from cyclonedds.core import InstanceState
        from cyclonedds.qos import Policy

        for endpoint in self._found.take(1000):
            key = endpoint.sample_info.instance_handle
            if endpoint.sample_info.instance_state != InstanceState.Alive:
                self._publications.pop(key, None)
            elif endpoint.participant_key != self._participant.guid:
                topic, kind = ros_topic(endpoint.topic_name), ros_type(endpoint.type_name)
                if topic is not None and kind is not None:
                    self._publications[key] = Publication(topic, kind)
                    if Policy.Userdata in endpoint.qos and (
                        said := _TYPE_HASH.search(endpoint.qos[Policy.Userdata].data)
                    ):
                        self._hashes[topic] = said[1].decode()
                    if endpoint.qos[Policy.Durability] == Policy.Durability.Volatile:
                        self._volatile.add(topic)
        return tuple(sorted(set(self._publications.values()), key=lambda p: (p.topic, p.message_type)))

    def has_volatile(self, topic: str) -> bool:
        """Whether one of the topic's publishers keeps nothing for late readers: a latched reader does not match it."""
        return topic in self._volatile

    def lost(self) -> Mapping[str, int]:
        """Messages that were lost on their way here, by topic."""
        with self._lock:
            readers = [*self._readers]
        counts = Counter[str]()
        for one in readers:
            counts[one.publication.topic] += int(one.reader.get_sample_lost_status().total_count)
        return +counts

    def writer(self, topic: str, message_type: str, latched: bool = False, messages: Messages | None = None) -> Writer:
        """A reliable writer; a latched one gives late readers what was written before (transient local)."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.qos import Policy, Qos

        types = messages or self.messages
        entity = self._topic(topic, message_type, types)
        qos = Qos(
            Policy.Reliability.Reliable(round(_BLOCK_S * 1e9)),
            Policy.History.KeepLast(_SENT_DEPTH),
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.DurabilityService(0, Policy.History.KeepLast(_LATCHED_DEPTH), -1, -1, -1),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            _hash_policy(types, message_type),
        )
        writer = DataWriter(self._participant, entity, qos=qos)
        return Writer(writer, entity.data_type, partial(types.encode, message_type))

    def read(self, topic: str, message_type: str, on_sample: OnSample, latched: bool = False) -> None:
        """Deliver a topic's messages from now on, in a thread of this object's.

        Quality of service is that of sensor data (best effort), which every publisher offers; of a latched topic
        reliable and transient local.
        """
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.sub import DataReader

        types = self._types[topic] = self._messages_of(topic, message_type)
        entity = self._topic(topic, message_type, types)
        qos = Qos(
            Policy.Reliability.Reliable(round(_BLOCK_S * 1e9)) if latched else Policy.Reliability.BestEffort,
            Policy.History.KeepLast(read_depth(message_type)),
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.IgnoreLocal.Participant,  # what we publish is no input
            _hash_policy(types, message_type),
        )
        reader = DataReader(self._participant, entity, qos=qos)
        unread = ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead)
        with self._lock:
            self._entering.append(_Reader(reader, unread, Publication(topic, message_type), on_sample))
        self._changed.set(True)

    def _messages_of(self, topic: str, message_type: str) -> Messages:
        """Types of the distribution that the topic's publisher tells by its type's hash: some differ, as Range does."""
        said = self._hashes.get(topic, "")
        if not said or said == self.messages.type_hash(message_type):
            return self.messages
        return Messages.of_hash(message_type, said) or self.messages

    def _topic(self, topic: str, message_type: str, messages: Messages) -> Any:
        from cyclonedds.core import DDSException
        from cyclonedds.topic import Topic

        if topic not in self._topics:
            kind = cdr_type(message_type, messages.layout(message_type))
            try:
                self._topics[topic] = Topic(self._participant, dds_topic(topic), kind)
            except DDSException as error:
                raise WireError(f"{topic} ({message_type}): DDS refuses the topic: {error.msg}") from error
        return self._topics[topic]

    def _read(self) -> None:
        while not self._closing.is_set():
            with self._lock:
                entering, self._entering = self._entering, []
            for entry in entering:
                self._waiting.attach(entry.unread)
                self._readers.append(entry)
            self._waiting.wait(round(_WAIT_S * 1e9))
            self._changed.take()
            self._deliver()

    def _deliver(self) -> None:
        """Deliver the messages that wait in all readers, in the order of writing."""
        for sample, on_sample in in_order([(one.depth, one.take) for one in self._readers]):
            try:
                on_sample(sample)
            except Exception as error:  # raised by the next call; the other topics go on
                self._failure = self._failure or error


def _hash_policy(messages: Messages, message_type: str) -> Any:
    """USER_DATA with the hash of a message type, as ROS 2's middlewares announce it from Iron on; empty without one."""
    from cyclonedds.qos import Policy

    type_hash = messages.type_hash(message_type)
    return Policy.Userdata(f"typehash={type_hash};".encode() if type_hash else b"")


def _loopback(domain: int) -> Domain:
    """Settings of a loopback domain, which all its participants in this process share."""
    from cyclonedds.domain import Domain

    with _domains_lock:
        known = _domains.get(domain)
        if known is None:
            known = _domains[domain] = Domain(domain, _LOOPBACK)
        return known


# --- Time: of /clock where there is one, else the machine's -----------------------------------------------------------

CLOCK = "/clock"
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"


class WireClock:
    """Follows /clock from its first message on."""

    def __init__(self, participant: Participant) -> None:
        """Subscribe to /clock."""
        self._messages = participant.messages
        self._lock = threading.Lock()
        self._simulated_ns: int | None = None
        participant.read(CLOCK, CLOCK_TYPE, self._on_clock)

    @property
    def simulated(self) -> bool:
        """Whether a message of /clock has been received."""
        return self._simulated_ns is not None

    def now_ns(self) -> int:
        """Time now [ns]; simulation time stands still between messages, as in ROS."""
        with self._lock:
            return time.time_ns() if self._simulated_ns is None else self._simulated_ns

    def received_ns(self, sample: Received) -> int:
        """Receive time of a message [ns]; see `transport.received_ns`."""
        return received_ns(sample.source_ns, self.now_ns(), self.simulated)

    def _on_clock(self, sample: Sample) -> None:
        stamp = self._messages.decode(CLOCK_TYPE, sample.cdr).clock
        with self._lock:
            self._simulated_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
