"""Publishers of a ROS 2 graph, written with Cyclone's own classes and without evercal.

    drivers.py camera KIND RELIABILITY WxH    images and camera_info, 15 a second
    drivers.py arm                            a shoulder that turns, a tool on it, static frames

Each line on stdin is a number: an arm stands at that angle, a camera shows that grey.
"""

# pyright: reportArgumentType=false
# Cyclone's classes take lists and bytes for their sequences.

import math
import sys
import threading
import time
from dataclasses import dataclass

import cv2
import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, types as t
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: t.int32
    nanosec: t.uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Image(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):
    header: Header
    height: t.uint32
    width: t.uint32
    encoding: str
    is_bigendian: t.uint8
    step: t.uint32
    data: t.sequence[t.uint8]


@dataclass
class CompressedImage(IdlStruct, typename="sensor_msgs.msg.dds_.CompressedImage_"):
    header: Header
    format: str
    data: t.sequence[t.uint8]


@dataclass
class RegionOfInterest(IdlStruct, typename="sensor_msgs.msg.dds_.RegionOfInterest_"):
    x_offset: t.uint32
    y_offset: t.uint32
    height: t.uint32
    width: t.uint32
    do_rectify: bool


@dataclass
class CameraInfo(IdlStruct, typename="sensor_msgs.msg.dds_.CameraInfo_"):
    header: Header
    height: t.uint32
    width: t.uint32
    distortion_model: str
    d: t.sequence[t.float64]
    k: t.array[t.float64, 9]
    r: t.array[t.float64, 9]
    p: t.array[t.float64, 12]
    binning_x: t.uint32
    binning_y: t.uint32
    roi: RegionOfInterest


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: t.float64
    y: t.float64
    z: t.float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: t.float64
    y: t.float64
    z: t.float64
    w: t.float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs.msg.dds_.Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs.msg.dds_.TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs.msg.dds_.TFMessage_"):
    transforms: t.sequence[TransformStamped]


RELIABLE = Policy.Reliability.Reliable(10**8)
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)
shown = [0.0]


def header(frame: str) -> Header:
    nanoseconds = time.time_ns()
    return Header(Time(nanoseconds // 10**9, nanoseconds % 10**9), frame)


def writer(participant, topic, kind, reliability=RELIABLE, latched=False):
    durability = Policy.Durability.Volatile
    if latched:
        durability = Policy.Durability.TransientLocal
    qos = Qos(reliability, durability, Policy.History.KeepLast(5), CDR)
    return DataWriter(participant, Topic(participant, topic, kind), qos)


def camera(kind: str, reliability: str, size: str) -> None:
    width, height = map(int, size.split("x"))
    qos = RELIABLE if reliability == "reliable" else Policy.Reliability.BestEffort
    participant = DomainParticipant(int(ENV["ROS_DOMAIN_ID"]))
    base = "rt/camera/image_raw"
    if kind == "raw":
        images = writer(participant, base, Image, qos)
    else:
        images = writer(participant, f"{base}/compressed", CompressedImage, qos)
    infos = writer(participant, "rt/camera/camera_info", CameraInfo, qos)
    f = float(width)
    k = [f, 0, width / 2, 0, f, height / 2, 0, 0, 1]
    while True:
        grey = int(shown[0])
        pixels = np.full((height, width, 3), grey, np.uint8)
        pixels[:, : width // 2] = (200, 100, 50)
        head = header("wrist_optical")
        if kind == "raw":
            data = pixels.tobytes()
            images.write(Image(head, height, width, "rgb8", 0, 3 * width, data))
        else:
            data = cv2.imencode(".jpg", pixels[..., ::-1])[1].tobytes()
            images.write(CompressedImage(head, "rgb8; jpeg compressed bgr8", data))
        roi = RegionOfInterest(0, 0, 0, 0, False)
        square = [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
        p = [*k[:3], 0, *k[3:6], 0, *k[6:], 0]
        name = "plumb_bob"
        lens = [0.1, -0.2, 0.0, 0.0, 0.0]
        infos.write(
            CameraInfo(head, height, width, name, lens, k, square, p, 0, 0, roi)
        )
        time.sleep(1 / 15)


def arm() -> None:
    participant = DomainParticipant(int(ENV["ROS_DOMAIN_ID"]))
    static = writer(participant, "rt/tf_static", TFMessage, latched=True)
    moving = writer(participant, "rt/tf", TFMessage)
    tool = Transform(Vector3(0.0, 0.0, 0.1), Quaternion(0.0, 0.0, 0.0, 1.0))
    base = Transform(Vector3(0.0, 0.0, 0.3), Quaternion(0.0, 0.0, 0.0, 1.0))
    static.write(
        TFMessage(
            [
                TransformStamped(header("base_link"), "shoulder", base),
                TransformStamped(header("elbow"), "tool0", tool),
            ]
        )
    )
    while True:
        half = shown[0] / 2
        turn = Quaternion(0.0, 0.0, math.sin(half), math.cos(half))
        joint = Transform(Vector3(0.5, shown[0], 0.2), turn)
        moving.write(TFMessage([TransformStamped(header("shoulder"), "elbow", joint)]))
        time.sleep(0.01)


def listen() -> None:
    for line in sys.stdin:
        shown[0] = float(line)


if __name__ == "__main__":
    from os import environ as ENV

    threading.Thread(target=listen, daemon=True).start()
    what, *words = sys.argv[1:]
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    {"camera": camera, "arm": arm}[what](*words)
