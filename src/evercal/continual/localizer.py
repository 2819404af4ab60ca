"""Localization by networks: predicted scene coordinates and PnP."""

from collections.abc import Sequence
from dataclasses import field, replace
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from evercal.classes import frozen
from evercal.continual.networks.descriptor import described
from evercal.continual.networks.device import device_of
from evercal.continual.networks.precision import autocast
from evercal.continual.scenes import LearnedScenes, SceneRecord
from evercal.continual.store import NetworkStore
from evercal.errors import InputError, require_numbers
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.hypothesis import Matches, Rough
from evercal.localization.intrinsics import cameras_in_scenes
from evercal.localization.matching import strided_patches
from evercal.localization.pnp import PnpOptions, PnpResult, solve_pnp, uncertain
from evercal.localization.query import Encoded
from evercal.recordings.images import as_rgb
from evercal.typing import Image, Strings


@frozen
class NetworkLocalizeOptions:
    """How networks locate an image."""

    candidates: int = 3
    """Scenes that are tried per image, at most."""
    margin: float = 0.15
    """Scenes whose best prototype is less similar than the best scene's by more are not tried."""
    pnp: PnpOptions = field(default_factory=lambda: PnpOptions(threshold_px=8.0))
    """RANSAC settings. Points of a network scatter more than landmarks, so the radius is wider."""
    refuses: bool = True
    """Whether a pose with too few inliers is refused; published methods answer for every image."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_numbers(self, ("candidates",), 1)
        require_numbers(self, ("margin",), 0)


def open_networks(path: Path, device: str = "auto") -> "NetworkLocalizer":
    """A localizer for a store of networks; `device` as for `device_of`."""
    where = device_of(device)
    scenes = NetworkStore.open(path).contents
    if not scenes.scenes:
        raise InputError(
            f"store {path}: no scene learned yet; run 'evercal learn' first"
        )
    return NetworkLocalizer(scenes.to(where))


class NetworkLocalizer:
    """Locates images by scene-coordinate networks of one or more scenes."""

    def __init__(
        self, scenes: LearnedScenes, options: NetworkLocalizeOptions | None = None
    ):
        self.contents = scenes
        self.options = options or NetworkLocalizeOptions()
        self._prototypes: list[torch.Tensor] = []
        for record in scenes.scenes:
            self._prototypes.append(record.prototypes.float().to(scenes.device))
        for head in scenes.heads:
            head.eval()

    @property
    def scenes(self) -> Strings:
        """Names of the scenes, in order of learning."""
        return tuple(record.name for record in self.contents.scenes)

    def localize(self, image: Image, camera: Camera | None = None) -> PoseEstimate:
        """Locate an image; see `Localizer.localize`.

        Inliers are patches whose predicted points agree with the pose, and the ratio is that of all
        patches. There are no `camera`, `terms` and `support`. The status is `failed` as well if the
        pose lies outside the cell of its scene.
        """
        began = perf_counter()
        image = as_rgb(image)
        scenes = self.contents
        cameras = _fitting_cameras(camera, image, scenes.scenes)
        features = scenes.encoder.encode(image, scenes.short_side)
        encoded = Encoded(features)
        scenes_tried = self._candidates(encoded, cameras)
        tried = [self._hypothesis(encoded, scene, cameras) for scene in scenes_tried]
        best = max(tried, key=_support)
        return self._answer(best, 1000 * (perf_counter() - began))

    @property
    def _decides_scene(self) -> bool:
        heads = self.contents.heads
        return len(heads) == 1 and heads[0].options.condition == "descriptor"

    def _candidates(
        self, encoded: Encoded, cameras: Sequence[Camera | None]
    ) -> list[int]:
        usable = [i for i, camera in enumerate(cameras) if camera]
        if self._decides_scene:
            return usable[:1]
        _, descriptor = described(encoded.features, self.contents.descriptor)
        similarity = np.full(len(cameras), -np.inf)
        for i in usable:
            similarity[i] = float((self._prototypes[i] @ descriptor).max())
        floor = similarity.max() - self.options.margin
        best_first = np.argsort(-similarity, kind="stable")
        similar = best_first[similarity[best_first] >= floor]
        return similar[: self.options.candidates].tolist()

    def _hypothesis(
        self,
        encoded: Encoded,
        scene: int,
        cameras: Sequence[Camera | None],
        moved: bool = False,
    ) -> Rough | None:
        camera = cameras[scene]
        assert camera, "only scenes whose camera fits are tried"
        small = camera.short_side_resized(self.contents.short_side)
        matches, patches = self._predicted(encoded, scene, small)
        rough = solve_pnp(matches.pixels, matches.points_m, small, self.options.pnp)
        if not rough:
            return None
        if self._decides_scene and not moved:
            other = self._scene_at(rough.pose, scene)
            if other is None:
                other = scene
            if cameras[other] not in (None, camera):
                # The pose lies in the cell of a scene with another camera: solve once more.
                return self._hypothesis(encoded, other, cameras, moved=True)
            if other != scene:
                atlas_from_other = self._atlas_from_base(other)
                across = atlas_from_other.inverse() @ self._atlas_from_base(scene)
                rough = PnpResult(across @ rough.pose, rough.inliers)
                matches = Matches(matches.pixels, across.apply(matches.points_m))
                scene = other
        pixels = matches.pixels[rough.inliers]
        points = matches.points_m[rough.inliers]
        pose = uncertain(pixels, points, small, rough.pose)
        return Rough(scene, pose, pixels, points, patches, len(pixels))

    def _atlas_from_base(self, scene: int) -> SE3:
        return self.contents.scenes[scene].cell.atlas_from_base

    @torch.inference_mode()
    def _predicted(
        self, encoded: Encoded, scene: int, camera: Camera
    ) -> tuple[Matches, int]:
        """Scene coordinates of patches in a scene's base frame, and the number of patches."""
        scenes = self.contents
        patches, pixels = strided_patches(encoded, camera, scenes.encoder.stride, 1)
        head, local = scenes.head_for(scene)
        features, descriptor = described(encoded.features, scenes.descriptor)
        with autocast(head.device):
            output = head(features, local, descriptor.expand(len(features), -1))
        in_atlas = output.points.cpu().double().numpy()
        base_from_atlas = self._atlas_from_base(scene).inverse()
        points = base_from_atlas.apply(in_atlas)[patches]
        valid = np.isfinite(points).all(1)
        return Matches(pixels[valid], points[valid]), len(patches)

    def _scene_at(self, base_from_camera: SE3, scene: int) -> int | None:
        """The scene in whose cell a pose of one scene lies."""
        atlas_from_base = self._atlas_from_base(scene)
        position = atlas_from_base.apply(base_from_camera.translation_m)
        return self.contents.atlas().scene_at(position)

    def _answer(self, best: Rough | None, milliseconds: float) -> PoseEstimate:
        if not best:
            return PoseEstimate.failed("fewer than 6 inliers", milliseconds)
        record = self.contents.scenes[best.scene]
        status, reason = self._status(best, record)
        estimate = PoseEstimate(
            status=status,
            reason=reason,
            scene=None,
            base_from_camera=None,
            covariance=None,
            inliers=best.inliers,
            inlier_ratio=best.inlier_ratio,
            milliseconds=milliseconds,
            support=_support(best),
        )
        if status != "ok":
            return estimate
        return replace(
            estimate,
            scene=record.name,
            base_from_camera=best.pose.pose,
            covariance=record.covariance_scale * best.pose.covariance,
            pixels=best.pixels,
            points_m=best.points_m,
        )

    def _status(self, best: Rough, record: SceneRecord):
        if self._scene_at(best.pose.pose, best.scene) != best.scene:
            return "failed", "the pose lies outside the cell of its scene"
        if self.options.refuses and best.inlier_ratio < record.inlier_threshold:
            share = 100 * best.inlier_ratio
            need = 100 * record.inlier_threshold
            reason = f"{share:.0f} % of the patches are inliers, {record.name} needs {need:.0f} %"
            return "unknown_scene", reason
        return "ok", ""


def _fitting_cameras(
    camera: Camera | None, image: Image, scenes: Sequence[SceneRecord]
) -> list[Camera | None]:
    """Intrinsics of an image in each scene, never guessed; None where its shape does not fit."""
    height, width = image.shape[:2]
    cameras: list[Camera | None] = list(cameras_in_scenes(camera, image, scenes))
    sizes = []
    for i, scene in enumerate(scenes):
        recorded = scene.adjusted_camera
        sizes.append(f"{scene.name} {recorded.width}x{recorded.height}")
        if not camera and not recorded.fits(width, height):
            cameras[i] = None
    if not any(cameras):
        raise InputError(
            f"image {width}x{height}: no scene was recorded at this aspect ratio"
            f" ({', '.join(sizes)}); give the image's intrinsics with `camera`"
        )
    return cameras


def _support(hypothesis: Rough | None) -> float:
    if not hypothesis:
        return 0.0
    return hypothesis.inlier_ratio * hypothesis.inliers**0.5
