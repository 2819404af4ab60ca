"""A ROS 2 graph of three processes: samples beside a bag of the same messages; rates and CPU."""

import runpy
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks.rows import Row, save
from evercal import Map, cli, load_recording
from evercal.geometry import pose_distance, pose_distance_mm_deg
from evercal.live.ros2.graph import Graph, header, make
from evercal.live.ros2.publishing import PosePublisher
from evercal.live.sources import open_camera, open_robot
from evercal.recordings import Recording
from evercal.recordings.formats.bags.file import CAMERA_INFO, COMPRESSED, IMAGE, TF
from evercal.recordings.frame import stated_grippers
from evercal.robot.frame_names import FrameNames

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "ros2_cell.py"
IMAGES = "/camera/image_raw"
TOPICS = {
    "/tf": TF[0],
    IMAGES: IMAGE,
    "/camera/camera_info": CAMERA_INFO,
}


def run(
    what: Literal["cell", "rates", "publish-raw", "publish-compressed"],
    folder: Path = Path("runs/ros2"),
    seconds: float = 20.0,
    per_second: float = 30.0,
) -> None:
    """Compare samples with a bag, or measure rates at 1280x720.

    Args:
        what: Samples (cell) or rates; the others are the publisher of rates.
        folder: New folder for recordings, or of the rows.
        seconds: Length of a stream.
        per_second: Images a second that are published.
    """
    if what.startswith("publish"):
        _publish(what.endswith("compressed"), seconds, per_second)
    elif what == "rates":
        rows = [_rate(kind, seconds, per_second) for kind in ("raw", "compressed")]
        save(folder / "ros2.csv", rows, {"seconds": seconds, "size": [1280, 720]})
    else:
        _cell(folder)


def _cell(folder: Path) -> None:
    folder.mkdir(parents=True)
    virtual_cell = runpy.run_path(str(EXAMPLE))["virtual_cell"]
    with virtual_cell(folder / "virtual"):
        done = threading.Event()
        to = (folder / "bag", done)
        bag = threading.Thread(target=_write_bag, args=to, daemon=True)
        bag.start()
        words = ["record", f"ros2:{IMAGES}", str(folder / "live"), "--most", "25"]
        cli.main(words)
        done.set()
        bag.join()
    live = load_recording(folder / "live")
    whole = load_recording(folder / "bag")
    same, pose_mm, pixels = _in_bag(live, whole)
    _learn(folder, live, same)
    print(f"poses differ by {pose_mm:.2g} mm at most, images by {pixels:.2f} of 255")


def _write_bag(path: Path, done: threading.Event) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    graph = Graph()
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {}
        topics = []
        for topic, kind in TOPICS.items():
            links[topic] = writer.add_connection(topic, kind, typestore=store)
            topics.append(graph.subscribe(topic, kind, True, depth=200))
        while not done.is_set():
            for topic in topics:
                for message in topic.take():
                    data = store.serialize_cdr(message.content, topic.kind)
                    writer.write(links[topic.topic], message.logged_ns, data)
            time.sleep(0.05)


def _in_bag(live: Recording, bag: Recording) -> tuple[Recording, float, float]:
    """The frames of the bag that were taken where the live ones were, and differences."""
    poses = stated_grippers(bag.train)
    frames = []
    worst = 0.0
    pixels = []
    for frame, pose in zip(live.train, stated_grippers(live.train), strict=True):
        metres, _ = pose_distance(pose, poses)
        here = np.flatnonzero(metres < metres.min() + 1e-7)
        number = int(here[len(here) // 2])
        own = bag.train[number]
        millimetres, _ = pose_distance_mm_deg(poses[number], pose)
        worst = max(worst, float(millimetres))
        difference = own.read_image().astype(float) - frame.read_image()
        pixels.append(np.abs(difference).mean())
        frames.append(own)
    return replace(bag, train=(*frames,)), worst, float(np.mean(pixels))


def _learn(folder: Path, live: Recording, bag: Recording) -> None:
    found = []
    for name, recording in (("live", live), ("bag", bag)):
        store = Map.open(folder / f"{name}.evercal")
        store.learn(recording)
        found.append(store.calibration())
        print(name, found[-1].frames, f"sigma {found[-1].sigma_mm:.3f} mm per axis")
    first, second = found
    apart = pose_distance_mm_deg(first.parent_from_child, second.parent_from_child)
    print(f"calibrations differ by {apart[0]:.3f} mm, {apart[1]:.4f} deg")
    publisher = PosePublisher(first.parent_frame, first.child_frame, static=True)
    publisher.publish(first.uncertain_pose, time.time())
    robot = open_robot("ros2:", FrameNames(first.parent_frame, first.child_frame))
    heard = robot.base_from_gripper()
    apart = pose_distance_mm_deg(first.parent_from_child, heard)
    print(f"/tf_static differs by {apart[0]:.2g} mm, {apart[1]:.2g} deg")


def _rate(kind: str, seconds: float, per_second: float) -> Row:
    words = ["--what", f"publish-{kind}", "--seconds", str(seconds + 3)]
    words += ["--per-second", str(per_second)]
    command = [sys.executable, "-m", "benchmarks", "ros2", *words]
    source = f"ros2:{IMAGES}" + ("/compressed" if kind == "compressed" else "")
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        camera = open_camera(source)
        camera.read()
        count = 0
        begun = time.monotonic()
        cpu = time.process_time()
        while time.monotonic() - begun < seconds:
            camera.read()
            count += 1
        cpu = time.process_time() - cpu
        sent, milliseconds = process.communicate()[0].split()
    return {
        "images": kind,
        "published_a_second": float(sent),
        "read_a_second": count / seconds,
        "cpu_ms_read": 1e3 * cpu / count,
        "cpu_ms_published": float(milliseconds),
    }


def _publish(compressed: bool, seconds: float, per_second: float) -> None:
    """Send one image many times; print how many a second, and CPU milliseconds of each."""
    rng = np.random.default_rng(0)
    small = rng.integers(0, 255, (90, 160, 3), np.uint8)
    pixels = cv2.resize(small, (1280, 720), interpolation=cv2.INTER_CUBIC)
    graph = Graph()
    kind = COMPRESSED if compressed else IMAGE
    topic = f"{IMAGES}/compressed" if compressed else IMAGES
    send = graph.publisher(topic, kind, False)
    words = (720, 1280, "rgb8", 0, 3840, pixels.ravel())
    if compressed:
        words = ("jpeg", cv2.imencode(".jpg", pixels)[1].ravel())
    begun = time.time()
    cpu = time.process_time()
    count = 0
    while time.time() < begun + seconds:
        send(make(kind, header("camera", time.time()), *words))
        count += 1
        time.sleep(max(0.0, begun + count / per_second - time.time()))
    print(count / seconds, 1e3 * (time.process_time() - cpu) / count)
