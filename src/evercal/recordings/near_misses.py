"""What a file or a folder is that is no recording, and how it becomes one."""

import re
from pathlib import Path

from evercal.recordings.formats.wrist import LAYOUTS, image_folders, pictures_in
from evercal.recordings.images import files_in
from evercal.recordings.poses.robot_poses import POSE_ENDINGS
from evercal.recordings.poses.row_files import by_alias
from evercal.storage.text_files import few

_KINDS = by_alias("""
one image; give the folder of the images and their poses: .png .jpg .jpeg .bmp .tif .tiff .webp
a video; 'evercal reconstruct' estimates camera poses of its images: .mp4 .mov .avi .mkv .webm .m4v
HDF5, whose contents every program names differently; write images and poses to a folder: .h5 .hdf5
a recording of a ZED camera, which only its SDK reads; export its images: .svo .svo2
Python objects, which are not read as they may run code; write the poses as CSV: .pkl .pickle .pt
part of a dataset; give the folder of meta/info.json, or convert it to LeRobot: .parquet .tfrecord
a container that is not read; write its images and poses to a folder: .zarr .lmdb .klg .oni .k4a
a model or point cloud; recordings are images with poses: .ply .pcd .obj .stl .glb .usd .usdz .las
no images; give the folder of the images, and this file as `poses`: .csv .json .jsonl .yaml .yml
no images; give the folder of the images, and this file as `poses`: .npy .npz .txt .tum .mat .log
""")
"""What files are and what to do, by ending."""
_POSES = re.compile(
    r"(?i)(?!base_from_camera).*(pose|traj|truth|extrinsic|odom|tcp|robot|transform)[^.]*"
    r"(\.(csv|jsonl?|ya?ml|np[yz]|mat|tum|txt|dat|log))?$"
)
"""Names of files and folders of poses."""
_WITHOUT = "base_from_gripper.csv, joints.csv or base_from_camera.csv"


def what_it_lacks(root: Path) -> str:
    """What a folder lacks to be a recording, or what a file is."""
    if root.is_file():
        return _KINDS.get(root.suffix.lower(), "a file, not a folder, and no bag")
    for folder in image_folders(root):
        return _beside(root, folder)
    for path in sorted(root.glob("*")):
        kind = _KINDS.get(path.suffix.lower(), "no images")
        if not kind.startswith("no images"):
            return f"no images; {path.name} is {kind}"
    return (
        "no known scene format, no images; give a bag, or a folder that holds images and"
        f" {_WITHOUT}, scene.json, transforms.json, sparse/0 or meta/info.json"
    )


def _beside(root: Path, folder: Path) -> str:
    """What is missing beside the images of a folder."""
    images = pictures_in(folder)
    count = f"{len(images)} images in {folder}"
    found = []
    for path in sorted(root.iterdir()):
        if _POSES.match(path.name) and path != folder:
            found.append(path.name)
    if len(files_in(folder, POSE_ENDINGS)) >= len(images):
        found = [str(folder.relative_to(root))]
    if found:
        return (
            f"{count}, and poses in {few(found)}: if they are of the camera, give `poses`"
            f" {found[0]}; if of the gripper, call them base_from_gripper with the same ending"
        )
    missing = _WITHOUT
    for layout in LAYOUTS:
        if layout.images and root / layout.images == folder:
            missing = layout.poses
    return (
        f"{count} without poses; add {missing}, give `poses` FILE of the camera, or estimate by"
        " 'evercal reconstruct'"
    )
