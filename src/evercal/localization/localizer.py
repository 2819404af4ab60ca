"""`Localizer`: an image in, a `PoseEstimate` out.

The way of an image: prepare, encode, retrieve scenes and keyframes, match (and ask the network,
where a scene has one), PnP, align landmarks, refine the pose, match again near a doubtful one,
accept. Whatever a store holds, every source gives 2D-3D correspondences and one solver takes them
all.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from evercal.errors import InputError
from evercal.features.device import device_of
from evercal.features.encode import encode_features
from evercal.features.views import View, ViewOptions, plain_view
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.localization.alignment import Alignment, align_pose
from evercal.localization.estimate import PoseEstimate
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.matching import Matcher
from evercal.localization.parallel import in_parallel
from evercal.localization.pnp import PnpResult, solve_pnp
from evercal.localization.query import Attempt, Candidate, Hypothesis, LocalizeOptions, Query
from evercal.mapping.scene_maps import SceneMaps, SceneRecord

ASPECT_TOLERANCE = 0.01


class Localizer:
    """Finds the camera in any of the scenes that a store knows.

    Images are encoded, matched and shown to networks where the encoder's weights lie; poses are
    computed on the CPU.

    Args:
        maps: encoder, scene records, keyframes and, where scenes have one, networks.
        options: how.
    """

    def __init__(self, maps: SceneMaps, options: LocalizeOptions | None = None):
        self.maps, self.options = maps, options or LocalizeOptions()
        self._view = ViewOptions(short_side=maps.short_side)
        self._bank = KeyframeBank(maps, self.options.loaded_keyframes)
        self._matcher = Matcher(maps, self._bank, self.options)
        for head in maps.heads:
            head.eval()

    @classmethod
    def open(
        cls,
        store: str | os.PathLike[str],
        options: LocalizeOptions | None = None,
        encoder: torch.nn.Module | None = None,
        device: str = "auto",
    ) -> Self:
        """A localizer for a store on disk.

        Args:
            store: its folder.
            options: how to locate.
            encoder: only for a store made with a module of one's own: that module.
            device: what the networks run on: `auto` (a CUDA device where there is one), `cpu` or
                `cuda`; see `features.device.device_of`.

        Raises:
            InputError: not a store, an empty one, or a damaged file; no such device.
        """
        where = device_of(device)
        from evercal.mapping.store import Store

        opened = Store.open(Path(store), encoder)
        if not opened.maps.scenes:
            raise InputError(f"store {store}: no scene learned yet; run 'evercal learn' first")
        return cls(opened.maps.to(where), options)

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order of learning."""
        return tuple(record.name for record in self.maps.scenes)

    def localize(self, image: np.ndarray, camera: Camera | None = None) -> PoseEstimate:
        """Camera pose of one image.

        Args:
            image: (h, w, 3) uint8 RGB or (h, w) grey.
            camera: its intrinsics; None takes those of the scene that is found, scaled.

        Raises:
            InputError: an array that is no such image, no camera given and the proportions fit no
                known scene's camera, or a camera whose proportions are not the image's.
        """
        began = time.perf_counter()
        view = self._prepare(image, camera)
        return self._locate(image, self._encode([view])[0], camera, began)

    def localize_batch(
        self, images: Sequence[np.ndarray], cameras: Sequence[Camera | None]
    ) -> list[PoseEstimate]:
        """`localize` for many images, some at a time; the answers are the same to the last bit."""
        pairs = list(zip(images, cameras, strict=True))
        return list(in_parallel(lambda pair: self.localize(*pair), pairs))

    def _prepare(self, image: np.ndarray, camera: Camera | None) -> View:
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
            raise InputError(
                f"image of shape {image.shape}, {image.dtype}: give (height, width, 3) uint8 RGB "
                "or (height, width) uint8 grey"
            )
        height, width = image.shape[:2]
        if camera is not None and not _same_shape(camera, width, height):
            raise InputError(
                f"camera {camera.width}x{camera.height} does not fit the image {width}x{height}: "
                "give the intrinsics of this image (any size of the same proportions will do)"
            )
        plain = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
        return plain_view(image, plain, self.maps.encoder.stride, self._view)

    def _encode(self, views: Sequence[View]) -> list[Tensor]:
        """(channels, rows, columns) features of views of one size, on the encoder's device."""
        return list(encode_features(views, self.maps.encoder))

    def _locate(
        self, image: np.ndarray, features: Tensor, camera: Camera | None, began: float
    ) -> PoseEstimate:
        query = Query(image, features, self.options.patches_short_side)
        cameras = self._cameras(camera, image.shape)
        usable = [i for i, c in enumerate(cameras) if c is not None]
        best: Hypothesis | None = None
        tried: set[tuple[int, int, bytes]] = set()
        attempts = self.options.attempts if len(self._bank) else (Attempt(0, 1),)
        for number, attempt in enumerate(attempts):
            for candidate in self._matcher.candidates(query, usable, attempt, self._one_answer()):
                same = candidate.scene, candidate.match_stride, candidate.keyframes.tobytes()
                if same in tried:
                    continue  # in a small store a wider attempt often asks the same
                tried.add(same)
                trial = self._hypothesis(query, candidate, cameras)
                trial = self._guided(query, trial, candidate, cameras)
                if best is None or trial.support > best.support:
                    best = trial
                if trial.aligned and self._accepted(trial, self.options.sure):
                    return self._answer(trial, began)
            # A pose that is only just good enough may be beaten by another attempt.
            if number and best is not None and best.aligned and self._accepted(best):
                break
        assert best is not None, "at least one scene is tried"
        return self._answer(best, began)

    def _cameras(self, camera: Camera | None, shape: tuple[int, ...]) -> list[Camera | None]:
        """Intrinsics of the image under each scene, None where the proportions do not fit."""
        height, width = shape[:2]
        found: list[Camera | None] = []
        for record in self.maps.scenes:
            lens = record.query_camera(camera)
            fits = _same_shape(lens, width, height)
            found.append(lens.resized(width, height) if fits else None)
        if not any(found):
            known = ", ".join(
                f"{r.name} {r.camera.width}x{r.camera.height}" for r in self.maps.scenes
            )
            raise InputError(
                f"image {width}x{height}: its proportions fit no known camera ({known}); "
                "give its intrinsics with --camera"
            )
        return found

    def _one_answer(self) -> bool:
        """Whether the network itself decides which scene answers (condition `descriptor`)."""
        heads = self.maps.heads
        return len(heads) == 1 and heads[0].options.condition == "descriptor"

    def _guided(
        self, query: Query, found: Hypothesis, candidate: Candidate, cameras: list[Camera | None]
    ) -> Hypothesis:
        """What guided matching finds near a pose of little support; see `clear`."""
        whole = replace(candidate, match_stride=1)
        while found.aligned and found.inliers and found.scene == candidate.scene:
            if found.support >= self.options.clear:
                break
            again = self._hypothesis(query, whole, cameras, found.pose)
            if again.support < self.options.gain * found.support:
                break
            found = again
        return found

    def _hypothesis(
        self,
        query: Query,
        candidate: Candidate,
        cameras: list[Camera | None],
        near: SE3 | None = None,
    ) -> Hypothesis:
        """A pose in one scene: match, PnP, align."""
        scene, camera = candidate.scene, cameras[candidate.scene]
        assert camera is not None, "only scenes whose camera fits are tried"
        pixels, points, cells = self._matcher.correspondences(query, candidate, camera, near)
        small = camera.short_side_resized(self.maps.short_side)
        intrinsics = np.array([small.fx, small.fy, small.cx, small.cy])
        rough = solve_pnp(pixels, points, intrinsics, self.options.pnp)
        if rough is None:
            return Hypothesis(scene)
        if self._one_answer():
            scene = self._scene_of(rough, scene)
            own = cameras[scene]
            if scene != candidate.scene and own is not None and own != camera:
                return self._hypothesis(query, replace(candidate, scene=scene), cameras)
            # Said in the frame of the scene that was asked, meant in that of the scene it found.
            asked, meant = (self.maps.scenes[i].cell for i in (candidate.scene, scene))
            across = meant.atlas_from_base.inverse() @ asked.atlas_from_base
            rough = replace(rough, world_from_camera=across @ rough.world_from_camera)
            points = across.apply(points)
        if len(candidate.keyframes) and self.options.align:
            return self._aligned(query, candidate, camera, rough)
        agree = rough.inliers
        sources = max(1, len(pixels) // cells)
        voices = agree[: sources * cells].reshape(sources, cells).any(0).sum()
        return Hypothesis(
            scene,
            rough.world_from_camera,
            rough.covariance,
            int(voices),
            float(voices) / cells,
            pixels[agree],
            points[agree],
        )

    def _aligned(
        self, query: Query, candidate: Candidate, camera: Camera, rough: PnpResult
    ) -> Hypothesis:
        height, width = query.grey.shape
        keyframes = [self._bank.load(int(index)).landmarks for index in candidate.keyframes]
        found: Alignment | None = align_pose(
            query.pyramid,
            camera.resized(width, height),
            keyframes,
            rough.world_from_camera,
            self.options.alignment,
        )
        if found is None:
            pose, covariance = rough.world_from_camera, rough.covariance
            return Hypothesis(candidate.scene, pose, covariance, aligned=True)
        scale = self.maps.short_side / min(height, width)
        return Hypothesis(
            candidate.scene,
            found.pose.base_from_camera,
            found.pose.covariance,
            len(found.pixels),
            found.share,
            (found.pixels + 0.5) * scale - 0.5,
            found.points_m,
            aligned=True,
            matched=found.matched,
            planned=found.planned,
        )

    def _scene_of(self, rough: PnpResult, scene: int) -> int:
        """The scene in whose cell of the atlas a pose lies."""
        atlas_from_base = self.maps.scenes[scene].cell.atlas_from_base
        place = atlas_from_base.apply(rough.world_from_camera.translation_m)
        found = self.maps.atlas().scene_at(place)
        return scene if found is None else found

    def _accepted(self, best: Hypothesis, times: float = 1.0) -> bool:
        record = self.maps.scenes[best.scene]
        if best.aligned:
            return best.inliers > 0 and best.support >= times * record.min_support
        return best.ratio >= record.inlier_threshold

    def _answer(self, best: Hypothesis, began: float) -> PoseEstimate:
        def refused(status, reason: str) -> PoseEstimate:
            ms = 1000 * (time.perf_counter() - began)
            return PoseEstimate(
                status,
                reason,
                None,
                None,
                None,
                best.inliers,
                best.ratio,
                ms,
                support=best.support,
            )

        record = self.maps.scenes[best.scene]
        if best.pose is None:
            return refused("failed", "no pose agrees with at least 6 patches of the image")
        if self._outside(best, record):
            return refused("failed", "the pose lies outside the cell of its scene")
        if not self._accepted(best):
            return refused("unknown_scene", _why(best, record))
        assert best.covariance is not None
        pose, covariance = record.stated(best.pose, best.doubt * best.covariance)
        return PoseEstimate(
            "ok",
            "",
            record.name,
            pose,
            covariance,
            best.inliers,
            best.ratio,
            1000 * (time.perf_counter() - began),
            best.pixels,
            record.stated_points(best.points_m),
            best.support,
        )

    def _outside(self, best: Hypothesis, record: SceneRecord) -> bool:
        """Whether a network's pose lies outside the cell of the scene that it was asked for.

        Only networks know of cells: a map may be looked at from far away.
        """
        assert best.pose is not None
        if best.aligned or not self.maps.heads:
            return False
        place = record.cell.atlas_from_base.apply(best.pose.translation_m)
        return self.maps.atlas().scene_at(place) != best.scene


def _why(best: Hypothesis, record: SceneRecord) -> str:
    if best.aligned:
        return (
            f"{best.inliers} landmarks, {100 * best.ratio:.0f} % of those that should be visible,"
            f" were found: support {best.support:.2f}, {record.name} needs {record.min_support:.2f}"
        )
    need = f"{100 * record.inlier_threshold:.0f} %"
    return f"{100 * best.ratio:.0f} % of the patches agree, {record.name} needs {need}"


def _same_shape(camera: Camera, width: int, height: int) -> bool:
    return abs(camera.width * height / (camera.height * width) - 1) < ASPECT_TOLERANCE
