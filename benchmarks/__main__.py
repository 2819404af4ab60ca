"""`python -m benchmarks VERB ...`: the measurements that the docs report."""

import importlib
import sys

import tyro

VERBS = {
    "maps": "accuracy of maps: degraded images, fixed cameras, wrong poses, sequences of scenes",
    "calibration": "cameras calibrated from images, compared with the simulator's truth",
    "trust": "other lenses, few images, an inaccurate arm: errors and their stated deviations",
    "same-model": "images of other cameras of the recording's model",
    "repeat": "a wrist camera before a chessboard, in three folds",
    "handeye": "pose pairs: errors, ellipsoids, outliers, scale, time",
    "boards": "detection of rendered boards, beside the finders of OpenCV",
    "handeye-boards": "boards through a lens found from the same images, beside other solvers",
    "next-views": "poses of a wrist recording until a stated accuracy, by how they are chosen",
    "virtual-cell": "record, learn and calibrate virtual cells, compared with their truth",
    "mistakes": "mistakes in pose files that must be refused and named, and clean recordings",
    "tracking": "a stream with holes: tracked, beside the location of single frames",
    "refresh": "a map in a rendered room that changes in ten rounds",
    "many-keyframes": "localization among thousands of keyframes of other rooms",
    "peers": "SIFT and XFeat on the same frames",
    "tune": "the setting of every continual method, on held-out training frames",
    "networks": "the experiments on networks: tuning, tables, figure; the paper's table on a GPU",
    "network-figure": "final accuracy over forgetting, a point for each method",
    "trainer": "time of a training step",
    "speed": "time of learning, localization and SARS",
    "serve": "latency of the HTTP service, alone and while a scene is learned",
    "memory": "memory of a service and of a tracker over many images",
    "many-recordings": "recordings learned at once, beside one after the other",
    "faults": "commands that are killed, full disks and read-only folders",
    "intervals": "coverage of confidence intervals",
    "publish": "write results to results/NAME.jsonl",
    "tables": "generate the tables of the docs from results/",
}
MODULES = {
    "handeye": "hand_eye",
    "handeye-boards": "hand_eye_boards",
    "many-keyframes": "many_keyframes",
    "many-recordings": "many_recordings",
    "network-figure": "network_figure",
    "next-views": "next_views",
    "virtual-cell": "virtual_cell",
    "refresh": "changing_room",
    "same-model": "same_model",
    "tune": "tuning",
}
"""Modules whose names differ from their verbs."""


def main(args: list[str]) -> int:
    """Run one measurement and return its exit code."""
    from evercal.errors import InputError

    verb, *rest = args or ["--help"]
    if verb not in VERBS:
        print("usage: python -m benchmarks VERB [--help]\n")
        print("\n".join(f"  {name:15} {summary}" for name, summary in VERBS.items()))
        return 0 if verb in ("-h", "--help") else 2
    module = importlib.import_module(f"benchmarks.{MODULES.get(verb, verb)}")
    try:
        return tyro.cli(module.run, args=rest, prog=f"python -m benchmarks {verb}") or 0
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
