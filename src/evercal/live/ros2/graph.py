"""`Graph`: a participant of a ROS 2 graph, by Cyclone DDS without ROS.

A topic `/tf` of ROS is `rt/tf` of DDS, and its type `tf2_msgs/msg/TFMessage` is
`tf2_msgs::msg::dds_::TFMessage_`. Cyclone passes messages as bytes; rosbags reads and writes them
as those of bags, which takes milliseconds for an image where Cyclone's own classes take a tenth of
a second.
"""

import math
import os
import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import (
    DDSException,
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.typesys import Stores, get_typestore

from evercal.errors import InputError
from evercal.recordings.formats.bags.file import Message
from evercal.typing import Strings

FIND_S = 5.0
"""Time that a publisher has to appear on the graph, seconds."""
_DOMAINS = 233
"""Domains of DDS with its usual ports."""
_WAIT_NS = 10**8
"""Time that Cyclone waits at once, nanoseconds."""
_ALIVE = ViewState.Any | SampleState.Any | InstanceState.Alive
_MANY = 10_000
"""More than arrive at once."""
_STORE = get_typestore(Stores.ROS2_HUMBLE)
"""Types of messages; those used here never changed."""
_ONE = threading.Lock()
"""Cyclone refuses topics that threads describe at the same time."""
_PLAIN = {"string": str, "bool": bool}


class Graph:
    """A participant of the domain that ROS_DOMAIN_ID names, else of domain 0."""

    def __init__(self) -> None:
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if domain not in map(str, range(_DOMAINS)):
            raise InputError(
                f"ROS_DOMAIN_ID {domain}: give a number from 0 to {_DOMAINS - 1}"
            )
        try:
            self._participant = DomainParticipant(int(domain))
        except DDSException as error:
            raise InputError(
                f"no ROS 2 graph can be joined ({error}); check the network and CYCLONEDDS_URI"
            ) from None
        self._writers = BuiltinDataReader(
            self._participant, BuiltinTopicDcpsPublication
        )

    def find(self, topic: str, kinds: Strings) -> "Subscription":
        """Read a topic of one of some types as its publishers offer it.

        Raises:
            InputError: Nobody publishes it within `FIND_S`.
        """
        end = time.monotonic() + FIND_S
        alive = ReadCondition(self._writers, _ALIVE)
        while True:
            writers = self._writers.read(_MANY, alive)
            writers = [one for one in writers if _kind(one) in kinds]
            own = [one for one in writers if one.topic_name == f"rt{topic}"]
            if own:
                offers = [one.qos[Policy.Reliability] for one in own]
                reliable = Policy.Reliability.BestEffort not in offers
                return self.subscribe(topic, _kind(own[0]), reliable)
            if time.monotonic() > end:
                break
            time.sleep(0.02)
        there = sorted({one.topic_name[2:] for one in writers}) or ["no topic"]
        raise InputError(
            f"ros2:{topic}: no {' or '.join(kinds)} is published there, but on {', '.join(there)};"
            " check the topic, the driver and ROS_DOMAIN_ID"
        )

    def subscribe(
        self,
        topic: str,
        kind: str,
        reliable: bool,
        latched: bool = False,
        depth: int = 1,
    ) -> "Subscription":
        """Read a topic, whoever publishes it; of a latched one also what was sent before.

        The last `depth` messages wait to be taken.
        """
        qos = _qos(reliable, latched, depth)
        reader = DataReader(self._participant, self._topic(topic, kind), qos)
        return Subscription(topic, kind, reader)

    def publisher(self, topic: str, kind: str, latched: bool) -> Callable[[Any], None]:
        """A function that sends a message; a latched one also reaches readers that come later."""
        own = self._topic(topic, kind)
        writer = DataWriter(self._participant, own, _qos(True, latched, 1))

        def publish(message: Any) -> None:
            data = _STORE.serialize_cdr(message, kind)
            writer.write(_wire(kind)(bytes(data)))

        return publish

    def _topic(self, topic: str, kind: str) -> Topic[Any]:
        with _ONE:
            return Topic(self._participant, f"rt{topic}", _wire(kind))


class Subscription:
    """The messages of one topic."""

    def __init__(self, topic: str, kind: str, reader: Any):
        self.topic = topic
        self.kind = kind
        self._reader = reader
        self._arrived = ReadCondition(reader, _ALIVE)
        self._waiting = WaitSet(reader.participant)
        self._waiting.attach(self._arrived)

    def take(self) -> list[Message]:
        """Those that have arrived, oldest first."""
        samples = self._reader.take(_MANY)
        return [self._decoded(one) for one in samples if one.sample_info.valid_data]

    def next(self, timeout_s: float | None = None) -> Message | None:
        """The first that arrives from now on; None after a time without one."""
        self._reader.take(_MANY)
        end = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while time.monotonic() < end:
            # Signals such as Ctrl-C wait as long as Cyclone does.
            self._waiting.wait(_WAIT_NS)
            for sample in self._reader.take(1, self._arrived):
                return self._decoded(sample)
        return None

    def _decoded(self, sample: Any) -> Message:
        try:
            content = _STORE.deserialize_cdr(memoryview(sample.data), self.kind)
        except Exception as error:  # whatever rosbags meets in the bytes
            raise InputError(f"ros2:{self.topic}: not a {self.kind}: {error}") from None
        return Message(self.topic, sample.sample_info.source_timestamp, 0, content)


def _kind(writer: Any) -> str:
    """Type of a writer as ROS writes it."""
    return writer.type_name.replace("::msg::dds_::", "/msg/").removesuffix("_")


def make(kind: str, *values: Any) -> Any:
    """A message such as `std_msgs/msg/Header` of its fields in order."""
    return _STORE.types[kind](*values)


def header(frame: str, stamp_s: float) -> Any:
    """The header of a message of a frame, at a time in seconds."""
    whole, nanoseconds = divmod(round(stamp_s * 1e9), 10**9)
    stamp = make("builtin_interfaces/msg/Time", whole, nanoseconds)
    return make("std_msgs/msg/Header", stamp, frame)


def _qos(reliable: bool, latched: bool, depth: int) -> Qos:
    return Qos(
        Policy.Reliability.Reliable(10**8)
        if reliable
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),  # as ROS 2
    )


@cache
def _wire(kind: str) -> Any:
    """The class of a type for Cyclone, whose objects hold its bytes."""

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
    fields = {field: _field(*what) for field, what in _STORE.fielddefs[kind][1]}
    return make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)


def _field(node: Any, what: Any) -> Any:
    if node.name == "NAME":
        return _struct(what)
    if node.name == "BASE":
        return _PLAIN.get(what[0]) or getattr(types, what[0])
    inner = _field(*what[0])
    if node.name == "ARRAY":
        return types.array[inner, what[1]]
    return types.sequence[inner]
