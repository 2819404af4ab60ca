"""`python -m benchmarks VERB ...`: the measurements that the docs report."""

import importlib
import sys

import tyro

VERBS = {
    "maps": (
        "maps",
        "accuracy of maps: degraded images, fixed cameras, wrong poses, many scenes",
    ),
    "audit": ("audit", "wrong camera poses in data sets, found by the arm in view"),
    "calibration": (
        "calibration",
        "cameras calibrated from images, beside the simulator's truth",
    ),
    "joint-offsets": (
        "joint_offsets",
        "offsets of an arm's joints from wrist recordings",
    ),
    "eye-to-hand": (
        "eye_to_hand",
        "a fixed camera and a textured thing in the gripper",
    ),
    "arm-in-view": (
        "arm_in_view",
        "a fixed camera and the arm in its images, also with what goes wrong",
    ),
    "trust": (
        "trust",
        "other cameras, few images, an inaccurate arm: errors and deviations",
    ),
    "lens-answers": (
        "lens_answers",
        "exported frames of a wrist camera whose driver states a wrong lens",
    ),
    "fisheye": (
        "fisheye",
        "rooms through lenses of 150 and 180 degrees, beside a pinhole",
    ),
    "guard": ("guard", "real rooms, far views, cameras not as stated; beside a commit"),
    "same-model": ("same_model", "images of other cameras of the recording's model"),
    "warps": ("warps", "images that no camera in the room makes"),
    "handeye": ("hand_eye", "pose pairs: errors, ellipsoids, outliers, scale, time"),
    "shared-errors": (
        "shared_errors",
        "arms whose stated poses err together: errors, sigma, few poses",
    ),
    "same-place": ("same_place", "one place in two scenes: bases, robots, twins"),
    "boards": ("boards", "detection of rendered boards, beside the finders of OpenCV"),
    "handeye-boards": ("hand_eye_boards", "boards and intrinsics from the same images"),
    "board-errors": (
        "board_errors",
        "boards with a rolling shutter, a stretched print, a wrong lens",
    ),
    "mistakes": ("mistakes", "mistakes in pose files, and clean recordings"),
    "recording-mistakes": (
        "recording_mistakes",
        "mistakes in the stated poses of recordings that are learned",
    ),
    "refusals": ("refusals", "the refusals of some folders, with examples of tests"),
    "pnp": ("pnp", "poses from matches with outliers, beside other solvers"),
    "refresh": ("changing_room", "a map in a rendered room that changes in ten rounds"),
    "same-answers": ("same_answers", "answers of this tree, beside a commit's"),
    "speed": ("speed", "time of learning, localization and SARS"),
    "tracking": ("tracking", "streams: wrong poses, ellipsoids, CPU time of a frame"),
    "serve": ("serve", "latency of the HTTP service"),
    "serve-streams": ("serve_streams", "streams to the HTTP service: losses, delays"),
    "retrieval": (
        "retrieval",
        "the right scene among 100,000 keyframes, milliseconds and bytes",
    ),
    "cluster": ("cluster", "learning and serving on a Ray cluster, beside one process"),
    "mutants": ("mutants", "small changes of the code that the tests should notice"),
    "networks": ("networks", "the experiments on networks; the paper's table on a GPU"),
    "sars-units": ("sars_units", "frames that SARS keeps, by the unit of positions"),
    "wheels": ("wheels", "what lacks wheels on the platforms of docs/install.md"),
    "depth-poses": ("depth_poses", "poses of 7-Scenes, of the depth or colour camera"),
    "layouts": ("layouts", "7-Scenes and 12-Scenes as published, with other images"),
    "verify": ("verify", "calibrations that err as stated, or more"),
    "fast-dds": ("fast_dds", "ROS 2 topics between evercal and Fast DDS"),
    "ros2": ("ros2", "a ROS 2 graph of three processes: samples, rates, CPU"),
    "tables": ("tables", "print the tables of the docs from results/"),
}
"""Module and summary of every verb."""


def main(args: list[str]) -> int:
    """Run one measurement and return its exit code."""
    from evercal.errors import InputError

    verb, *rest = args or ["--help"]
    if verb not in VERBS:
        print("usage: python -m benchmarks VERB [--help]\n")
        print(
            "\n".join(f"  {name:18} {summary}" for name, (_, summary) in VERBS.items())
        )
        return 0 if verb in ("-h", "--help") else 2
    module = importlib.import_module(f"benchmarks.{VERBS[verb][0]}")
    try:
        return tyro.cli(module.run, args=rest, prog=f"python -m benchmarks {verb}") or 0
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
