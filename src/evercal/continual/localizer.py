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
        for head in scenes.heads:
            head.eval()

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
        features = scenes.encoder.encode(image, scenes.short_side)
        encoded = Encoded(features)
        scenes_tried = self._candidates(encoded, cameras)
        tried = []
        for scene in scenes_tried:
            camera = cameras[scene]
            assert camera, "only scenes whose camera fits are tried"
            tried.append(self._hypothesis(encoded, scene, camera))
        best = max(tried, key=_support)
        return self._answer(best, 1000 * (perf_counter() - began))

    def _candidates(
        self, encoded: Encoded, cameras: Sequence[Camera | None]
    ) -> list[int]:
        """Scenes to try, whose prototypes are most similar to the image's descriptor.

        A head that reads the descriptor has one output for all scenes, so only the first is tried.
        """
        usable = [i for i, camera in enumerate(cameras) if camera]
        _, descriptor = described(encoded.features, self.contents.descriptor)
        similarity = np.full(len(cameras), -np.inf)
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
        covariance = None
        if self.options.refuses:
            covariance = record.covariance_scale * best.pose.covariance
        return replace(
            estimate,
            scene=record.name,
            base_from_camera=best.pose.pose,
            covariance=covariance,
            pixels=best.pixels,
            points_m=best.points_m,
        )

    def _status(self, best: Rough, record: SceneRecord):
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
