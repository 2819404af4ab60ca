"""A map from a phone's video, brought into the base frame by a few images of the arm's camera.

    python examples/05_phone_map.py [VIDEO IMAGES POSES]

It needs the extra `colmap`. By default, video and images are rendered.
"""

import sys
from pathlib import Path

from stand_ins import phone_video

import evercal
from evercal.recordings.reconstruct import reconstruct


def main(video: Path, images: Path, poses: Path) -> None:
    """Map what the video shows, in the base frame, and calibrate a camera in it."""
    built = reconstruct(video, "capture")
    print(f"{built.posed} of {built.frames} frames have a pose")
    room = evercal.Map.open("phone.evercal")
    room.learn("capture", name="cell", memory="30%")
    aligned = room.align("cell", images, robot_poses=poses)
    print(f"{aligned.used} of {aligned.given} images, sigma {aligned.sigma[0]:.1f} mm")
    print(room.calibrate("phone/tripod").verdict)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        phone_video(Path("phone.mp4"), Path("phone"))
        sys.argv += [
            "phone.mp4",
            "phone/wrist/images",
            "phone/wrist/base_from_gripper.csv",
        ]
    main(*map(Path, sys.argv[1:]))
