"""A scene of a map from a recording: keyframes, landmarks, poses and their scatter."""

from time import perf_counter

from evercal.geometry import SE3
from evercal.learning.posed import learn_posed, require_usable
from evercal.learning.report import LearnReport
from evercal.mapping.build import MapOptions
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.processes import one_product_thread
from evercal.progress import OnProgress
from evercal.recordings import posed_recording
from evercal.recordings.fixed_pixels import without_fixed_pixels
from evercal.recordings.frame import Recording, lacks_camera_poses
from evercal.recordings.held_out import require_frames, split_held_out


@one_product_thread()
def learn_scene(
    recording: Recording,
    contents: MapContents,
    memory: str | int | None = None,
    gripper_from_camera: SE3 | None = None,
    options: MapOptions | None = None,
    on_progress: OnProgress = lambda *_: None,
) -> tuple[SceneMap, LearnReport]:
    """Build the map of one scene and fit the scatter of its stated poses; nothing is written.

    Args:
        recording: Its training frames are learned; test frames are not read. If it states gripper
            poses only, `gripper_from_camera` is estimated, see `learn_wrist`.
        contents: Encoder, and the scenes that the report counts. The new scene does not depend on
            them.
        memory: Keyframes to keep, as for `Map.learn`.
        gripper_from_camera: A rough one that the estimate is compared with.
        options: Sizes and priors of the map; `memory` overrides theirs.
        on_progress: Called with the current step, how much of it is done, and its total.
    """
    began = perf_counter()
    budget = MemoryBudget.parse(memory)
    options = options or MapOptions()
    require_usable(recording)
    if lacks_camera_poses(recording):
        from evercal.learning.wrist import learn_wrist

        return learn_wrist(
            recording, contents, budget, gripper_from_camera, options, on_progress
        )
    recording = posed_recording(recording)
    require_frames(recording)
    recording, fixed_share = without_fixed_pixels(recording)
    split = split_held_out(recording.train)
    learned = learn_posed(recording, split, contents, budget, options, on_progress)
    return learned.scene, learned.report(contents, began, fixed_share)
