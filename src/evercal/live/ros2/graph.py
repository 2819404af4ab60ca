"""`Graph`: a participant of a ROS 2 graph, by Cyclone DDS without ROS.

A topic `/tf` of ROS is `rt/tf` of DDS, and its type `tf2_msgs/msg/TFMessage` is
`tf2_msgs::msg::dds_::TFMessage_`. Cyclone passes messages as bytes; rosbags decodes them as those
of bags, a large image 100 times as fast as Cyclone's own Python classes.
"""

import os
import time
from functools import cache
from typing import Any

from evercal.errors import InputError, optional_module
from evercal.recordings.formats.bags.file import Message

PREFIX = "ros2:"
"""Begin of the address of a topic, such as `ros2:/camera/image_raw`."""
FIND_S = 5.0
"""Time that a publisher has to appear on the graph, seconds."""
_NEED = f"{PREFIX} needs cyclonedds and rosbags"
_DAYS_NS = 10**15
"""Longer than anyone waits, nanoseconds."""


class Graph:
    """A participant of the domain that ROS_DOMAIN_ID names, else of domain 0."""

    def __init__(self) -> None:
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not domain.isdigit() or int(domain) > 232:
            raise InputError(f"ROS_DOMAIN_ID {domain}: a domain is 0 to 232")
        self.domain = int(domain)
        try:
            participant = _dds("domain").DomainParticipant(self.domain)
        except _dds("core").DDSException as error:
            raise InputError(
                f"no ROS 2 graph can be joined in domain {domain} ({error}); check the network and"
                " CYCLONEDDS_URI"
            ) from None
        self.participant: Any = participant
        builtin = _dds("builtin")
        publications = builtin.BuiltinTopicDcpsPublication
        self._publishers = builtin.BuiltinDataReader(participant, publications)

    def topics(self) -> dict[str, tuple[str, bool]]:
        """By topic that is published now: its type, and whether all writers are reliable."""
        core = _dds("core")
        alive = core.ViewState.Any | core.SampleState.Any | core.InstanceState.Alive
        condition = core.ReadCondition(self._publishers, alive)
        best_effort = core.Policy.Reliability.BestEffort
        topics: dict[str, tuple[str, bool]] = {}
        for writer in self._publishers.read(10_000, condition):
            prefix, _, topic = writer.topic_name.partition("/")
            package, _, name = writer.type_name.partition("::msg::dds_::")
            if prefix == "rt" and name:
                topic = f"/{topic}"
                reliable = writer.qos[core.Policy.Reliability] != best_effort
                _, others = topics.get(topic, ("", True))
                kind = f"{package}/msg/{name.removesuffix('_')}"
                topics[topic] = (kind, reliable and others)
        return topics

    def subscribe(
        self, topic: str, kinds: tuple[str, ...], depth: int = 1
    ) -> "Subscription":
        """Read a topic of one of some types as its publishers offer it.

        Raises:
            InputError: Nobody publishes it within `FIND_S`.
        """
        end = time.monotonic() + FIND_S
        while (found := self.topics().get(topic, ("", False)))[0] not in kinds:
            if time.monotonic() > end:
                raise InputError(self._absent(topic, kinds))
            time.sleep(0.02)
        return Subscription(self, topic, *found, depth)

    def _absent(self, topic: str, kinds: tuple[str, ...]) -> str:
        names = sorted(
            name for name, (kind, _) in self.topics().items() if kind in kinds
        )
        what = " or ".join(kind.replace("/msg", "") for kind in kinds)
        there = ", ".join(names) or "none"
        return (
            f"{PREFIX}{topic}: nobody publishes {what} there in domain {self.domain}; topics of"
            f" this type: {there}. Check the driver and ROS_DOMAIN_ID"
        )


class Subscription:
    """A reader of one topic that keeps the last messages, `latched` ones from before, too."""

    def __init__(self, graph: Graph, topic: str, kind: str, reliable: bool, depth: int):
        core = _dds("core")
        self._graph = graph
        self.topic = topic
        self.kind = kind
        latched = topic.endswith("tf_static")
        endpoint = _topic(graph, topic, kind)
        qos = _qos(reliable or latched, latched, depth)
        self._reader = _dds("sub").DataReader(graph.participant, endpoint, qos)
        unread = core.ViewState.Any | core.SampleState.NotRead | core.InstanceState.Any
        self._condition = core.ReadCondition(self._reader, unread)
        self._unread = core.WaitSet(graph.participant)
        self._unread.attach(self._condition)

    def take(self) -> list[Message]:
        """Decode the messages that have arrived, oldest first."""
        messages = []
        for sample in self._samples():
            messages.append(self._decoded(sample))
        return messages

    def next(self, timeout_s: float | None = None) -> Message | None:
        """The first message that arrives from now on; None after a time without one."""
        self._samples()
        timeout_ns = _DAYS_NS if timeout_s is None else int(timeout_s * 1e9)
        self._unread.wait(timeout_ns)
        for message in self.take():
            return message
        return None

    def _samples(self) -> list[Any]:
        samples = self._reader.take(10_000, self._condition)
        return [sample for sample in samples if sample.sample_info.valid_data]

    def _decoded(self, sample: Any) -> Message:
        try:
            content = _types().deserialize_cdr(memoryview(sample.data), self.kind)
        except Exception as error:  # whatever rosbags meets in the bytes
            raise InputError(
                f"{PREFIX}{self.topic}: a message that is no {self.kind}: {error}"
            ) from None
        return Message(self.topic, sample.sample_info.source_timestamp, 0, content)


class Publisher:
    """A reliable writer of one topic; a latched one also serves readers that come later."""

    def __init__(self, graph: Graph, topic: str, kind: str, latched: bool = False):
        self._kind = kind
        self._graph = graph
        endpoint = _topic(graph, topic, kind)
        qos = _qos(True, latched, 1)
        self._writer = _dds("pub").DataWriter(graph.participant, endpoint, qos)

    def publish(self, message: Any) -> None:
        """Send a message of rosbags' class."""
        data = bytes(_types().serialize_cdr(message, self._kind))
        self._writer.write(_wire(self._kind)(data))


def make(kind: str, **fields: Any) -> Any:
    """A message of rosbags' class, such as of `std_msgs/msg/Header`."""
    return _types().types[kind](**fields)


def _dds(module: str) -> Any:
    return optional_module(f"cyclonedds.{module}", _NEED, "ros2")


@cache
def _types() -> Any:
    typesys = optional_module("rosbags.typesys", _NEED, "ros2")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def _qos(reliable: bool, latched: bool, depth: int) -> Any:
    policy = _dds("core").Policy
    reliability = policy.Reliability.BestEffort
    if reliable:
        reliability = policy.Reliability.Reliable(10**8)
    durability = policy.Durability.Volatile
    if latched:
        durability = policy.Durability.TransientLocal
    # ROS 2 writes and reads the first version of CDR.
    version = policy.DataRepresentation(use_cdrv0_representation=True)
    history = policy.History.KeepLast(depth)
    return _dds("core").Qos(reliability, durability, history, version)


def _topic(graph: Graph, topic: str, kind: str) -> Any:
    return _dds("topic").Topic(graph.participant, f"rt{topic}", _wire(kind))


@cache
def _wire(kind: str) -> Any:
    """The class of a type for Cyclone, whose messages stay bytes."""

    class Wire:
        __idl__ = _struct(kind).__idl__

        def __init__(self, data: bytes):
            self.data = data

        @classmethod
        def deserialize(cls, data: bytes) -> Any:
            return cls(data)

        deserialize_key = deserialize

        def serialize(self, **_: Any) -> bytes:
            return self.data

    return Wire


@cache
def _struct(kind: str) -> Any:
    """Cyclone's description of a type of rosbags, by which participants compare types."""
    package, _, name = kind.split("/")
    fields = {}
    for field, description in _types().fielddefs[kind][1]:
        fields[field] = _field(*description)
    typename = f"{package}.msg.dds_.{name}_"
    return _dds("idl").make_idl_struct(f"{name}_", typename, fields)


def _field(node: Any, what: Any) -> Any:
    idl = _dds("idl.types")
    if node.name == "NAME":
        return _struct(what)
    if node.name == "BASE":
        return {"string": str, "bool": bool}.get(what[0]) or getattr(idl, what[0])
    inner = _field(*what[0])
    if node.name == "ARRAY":
        return idl.array[inner, what[1]]
    return idl.sequence[inner]
