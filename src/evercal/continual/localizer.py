"""Localization by networks: predicted scene coordinates and PnP."""

from collections.abc import Collection, Sequence
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
from evercal.geometry import Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.hypothesis import Matches, Rough
from evercal.localization.intrinsics import cameras_in_scenes
from evercal.localization.matching import strided_patches
from evercal.localization.pnp import PnpOptions, solve_pnp, uncertain
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
    """Whether a pose with too few inliers is refused. Published methods answer for every image.
    Their poses have no covariance, because its scale is fitted together with the threshold."""

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

    @property
    def scenes(self) -> Strings:
        """Names of the scenes, in order of learning."""
        return tuple(record.name for record in self.contents.scenes)

    def localize(self, image: Image, camera: Camera | None = None) -> PoseEstimate:
        """Locate an image; see `Localizer.localize`.

        Inliers are patches whose predicted points agree with the pose, and the ratio is that of all
        patches. There are no `camera`, `terms` and `support`.
        """
        began = perf_counter()
        image = as_rgb(image)
        scenes = self.contents
        cameras = _fitting_cameras(camera, image, scenes.scenes)
        encoded = Encoded(scenes.encoder.encode(image, scenes.short_side))
        tried = []
        for scene in self._candidates(encoded, cameras):
            rough = self._hypothesis(encoded, scene, cameras[scene])
            if rough:
                tried.append(rough)
        milliseconds = 1000 * (perf_counter() - began)
        if not tried:
            return PoseEstimate.failed("fewer than 6 inliers", milliseconds)
        return self._answer(max(tried, key=_support), milliseconds)

    def _candidates(self, encoded: Encoded, usable: Collection[int]) -> list[int]:
        """Usable scenes to try, whose prototypes are most similar to the image's descriptor.

        A head that reads the descriptor has one output for all scenes, so only the first is tried.
        """
        _, descriptor = described(encoded.features, self.contents.descriptor)
        similarity = np.full(len(self._prototypes), -np.inf)
        for i in usable:
            similarity[i] = float((self._prototypes[i] @ descriptor).max())
        floor = similarity.max() - self.options.margin
        best_first = np.argsort(-similarity, kind="stable")
        similar = best_first[similarity[best_first] >= floor]
        count = self.options.candidates
        heads = self.contents.heads
        if len(heads) == 1 and heads[0].options.condition == "descriptor":
            count = 1
        return similar[:count].tolist()

    def _hypothesis(
        self,
        encoded: Encoded,
        scene: int,
        camera: Camera,
    ) -> Rough | None:
        small = camera.short_side_resized(self.contents.short_side)
        matches, patches = self._predicted(encoded, scene, small)
        rough = solve_pnp(matches.pixels, matches.points_m, small, self.options.pnp)
        if not rough:
            return None
        pixels = matches.pixels[rough.inliers]
        points = matches.points_m[rough.inliers]
        pose = uncertain(pixels, points, small, rough.pose)
        return Rough(scene, pose, pixels, points, patches, len(pixels))

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
        base_from_atlas = scenes.scenes[scene].cell.atlas_from_base.inverse()
        points = base_from_atlas.apply(in_atlas)[patches]
        valid = np.isfinite(points).all(1)
        return Matches(pixels[valid], points[valid]), len(patches)

    def _answer(self, best: Rough, milliseconds: float) -> PoseEstimate:
        record = self.contents.scenes[best.scene]
        estimate = PoseEstimate(
            status="ok",
            reason="",
            scene=record.name,
            base_from_camera=best.pose.pose,
            covariance=record.covariance_scale * best.pose.covariance,
            inliers=best.inliers,
            inlier_ratio=best.inlier_ratio,
            milliseconds=milliseconds,
            pixels=best.pixels,
            points_m=best.points_m,
            support=_support(best),
        )
        if not self.options.refuses:
            return replace(estimate, covariance=None)
        if best.inlier_ratio >= record.inlier_threshold:
            return estimate
        share = 100 * best.inlier_ratio
        need = 100 * record.inlier_threshold
        reason = f"{share:.0f} % of the patches are inliers, {record.name} needs {need:.0f} %"
        refused = PoseEstimate.failed(reason, milliseconds)
        return replace(
            refused,
            status="unknown_scene",
            inliers=best.inliers,
            inlier_ratio=best.inlier_ratio,
            support=_support(best),
        )


def _fitting_cameras(
    camera: Camera | None, image: Image, scenes: Sequence[SceneRecord]
) -> dict[int, Camera]:
    """Intrinsics of an image by scene, never guessed; without scenes whose shape does not fit."""
    height, width = image.shape[:2]
    fitting = {}
    sizes = []
    for i, own in enumerate(cameras_in_scenes(camera, image, scenes)):
        recorded = scenes[i].camera
        sizes.append(f"{scenes[i].name} {recorded.width}x{recorded.height}")
        if camera or recorded.fits(width, height):
            fitting[i] = own
    if not fitting:
        raise InputError(
            f"image {width}x{height}: no scene was recorded at this aspect ratio"
            f" ({', '.join(sizes)}); give the image's intrinsics with `camera`"
        )
    return fitting


def _support(hypothesis: Rough) -> float:
    return hypothesis.inlier_ratio * hypothesis.inliers**0.5
