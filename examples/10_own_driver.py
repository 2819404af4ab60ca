"""Record with your own drivers: one that reads images, and one that states gripper poses.

python examples/10_own_driver.py [ADDRESS CAMERA.json]    # of a UR; default: a virtual cell
"""

import sys
from pathlib import Path

from scipy.spatial.transform import Rotation
from stand_ins import VisitingCell

from evercal import SE3
from evercal.live.recorder import WristRecorder
from evercal.live.sampling import samples
from evercal.live.sources import open_camera
from evercal.recordings.cameras.camera_file import read_camera


class UniversalRobot:
    """An arm by RTDE, as ur_rtde documents it (not run on an arm), and a camera by OpenCV."""

    def __init__(self, address: str, intrinsics: str):
        from rtde_receive import RTDEReceiveInterface  # pip install ur_rtde

        self._state = RTDEReceiveInterface(address)
        self.intrinsics = read_camera(Path(intrinsics))
        self.read = open_camera("0").read  # returns seconds and an RGB image

    def base_from_gripper(self) -> SE3:
        """The tool in the frame `base` of the controller: metres, rotation vector."""
        x, y, z, *turn = self._state.getActualTCPPose()
        return SE3.of(Rotation.from_rotvec(turn), [x, y, z])


cell = UniversalRobot(*sys.argv[1:]) if sys.argv[1:] else VisitingCell()
recorder = WristRecorder(Path("driver"), cell.intrinsics)
for _, taken in zip(range(25), samples(cell.read, cell), strict=False):
    print(recorder.add(*taken).name)
