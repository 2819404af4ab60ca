"""ROS 2 topics between evercal, which uses Cyclone DDS, and a process that uses Fast DDS.

It needs a compiler and the library, on Debian and Ubuntu the package libfastrtps-dev.
"""

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from benchmarks.rows import Row, show
from evercal.errors import InputError
from evercal.geometry import SE3, UncertainPose
from evercal.live.ros2.camera import Ros2Camera
from evercal.live.ros2.graph import Graph, header, make
from evercal.live.ros2.publishing import POSE, PosePublisher
from evercal.recordings.formats.bags.file import IMAGE, TF

SECONDS = 5.0
"""Time that images are received."""
SIZE = (720, 1280)
_STORE = get_typestore(Stores.ROS2_HUMBLE)


def run(domain: int = 77) -> None:
    """Print what arrives of images, latched transforms and published poses, both ways.

    Args:
        domain: ROS_DOMAIN_ID of the measurement.
    """
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    with tempfile.TemporaryDirectory() as folder:
        peer = Peer(Path(folder))
        rows = [_images(peer, quality) for quality in ("best", "reliable")]
        rows += [_late(peer), *_published(peer)]
    show(rows)


class Peer:
    """The program of peer.cpp."""

    def __init__(self, folder: Path):
        self._folder = folder
        source = Path(__file__).with_name("peer.cpp")
        command = ["g++", "-O2", "-std=c++17", "-w", source, "-o", folder / "peer"]
        try:
            subprocess.run([*command, "-lfastrtps", "-lfastcdr"], check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise InputError(
                f"{source}: not compiled ({error}); install g++ and libfastrtps-dev"
            ) from None

    @contextmanager
    def publishing(
        self, topic: str, kind: str, message: Any, *words: str
    ) -> Iterator[None]:
        """Publish a message again and again, a latched one once."""
        file = self._folder / "sent.cdr"
        file.write_bytes(bytes(_STORE.serialize_cdr(message, kind)))
        with self._started("pub", topic, kind, *words, "30", "60", file) as process:
            yield
            process.terminate()

    def received(self, topic: str, kind: str, *words: str) -> Any:
        """The last message of a topic within a few seconds; None without any."""
        file = self._folder / "received.cdr"
        file.unlink(missing_ok=True)
        with self._started("sub", topic, kind, *words, "1", "4", file) as process:
            process.wait()
        if not file.is_file():
            return None
        return _STORE.deserialize_cdr(file.read_bytes(), kind)

    def _started(
        self, mode: str, topic: str, kind: str, *words: str | Path
    ) -> subprocess.Popen[bytes]:
        package, _, name = kind.split("/")
        wire = f"{package}::msg::dds_::{name}_"
        command = [self._folder / "peer", mode, f"rt{topic}", wire, *words]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def _images(peer: Peer, quality: str) -> Row:
    pixels = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)
    height, width = SIZE
    words = (height, width, "rgb8", 0, 3 * width, pixels.ravel())
    message = make(IMAGE, header("camera", 5.0), *words)
    count = 0
    with peer.publishing("/cam/image_raw", IMAGE, message, quality, "volatile"):
        camera = Ros2Camera("ros2:/cam/image_raw")
        camera.read()
        began = time.process_time()
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            _, image = camera.read()
            assert np.array_equal(image, pixels)
            count += 1
        spent = time.process_time() - began
    what = f"{count / SECONDS:.0f} images/s, {1000 * spent / count:.1f} ms CPU each"
    return {"what": f"image_raw 1280x720, 30 a second, {quality}", "arrived": what}


def _late(peer: Peer) -> Row:
    place = make("geometry_msgs/msg/Vector3", 1.0, 2.0, 3.0)
    turn = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    moved = make("geometry_msgs/msg/Transform", place, turn)
    own = header("base", 5.0)
    moved = make("geometry_msgs/msg/TransformStamped", own, "tool0", moved)
    message = make(TF[0], [moved])
    with peer.publishing("/tf_static", TF[0], message, "reliable", "latched"):
        time.sleep(2.0)
        topic = Graph().subscribe("/tf_static", TF[0], True, True, 100)
        end = time.monotonic() + SECONDS
        arrived = []
        while not arrived and time.monotonic() < end:
            arrived = topic.take()
            time.sleep(0.05)
    frames = [one.content.transforms[0].child_frame_id for one in arrived]
    return {"what": "tf_static, a late joiner", "arrived": ", ".join(frames) or "-"}


def _published(peer: Peer) -> Iterator[Row]:
    pose = UncertainPose(SE3.exp([1, 2, 3, 0.1, 0.2, 0.3]), np.eye(6))
    publisher = PosePublisher("base", "camera", True)
    publisher.publish(pose, 5.0)
    for topic, kind in zip(publisher.topics, (TF[0], POSE), strict=True):
        arrived = peer.received(topic, kind, "reliable", "latched")
        yield {"what": f"{topic} of evercal", "arrived": "yes" if arrived else "-"}
