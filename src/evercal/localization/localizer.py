"""`Localizer`: from an image to the pose of its camera."""

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Self

import numpy as np
import torch
from torch import Tensor

from evercal.errors import InputError
from evercal.features.encode import ENCODE_BATCH, encode
from evercal.features.precision import autocast
from evercal.features.views import View, ViewOptions, ideal_cell_pixels, plain_view
from evercal.geometry.camera import Camera
from evercal.localization.estimate import PoseEstimate
from evercal.localization.keyframe_matcher import KeyframeMatcher, PosePrior, Votes
from evercal.localization.pnp import PnpOptions, PnpResult, solve_pnp
from evercal.mapping.scene_maps import SceneMaps

ASPECT_TOLERANCE = 0.01
# The first RANSAC pass uses every 4th correspondence; the pose itself comes from all.
FIRST_PASS_STRIDE = 4


@dataclass(frozen=True)
class LocalizeOptions:
    """How an image is located."""

    candidates: int = 3
    """At most this many scenes are tried for an image."""
    votes: float = 0.3
    """Where keyframes are matched, cells vote for the scene that has the most similar one;
    scenes with a smaller share of the best scene's votes are not tried."""
    margin: float = 0.15
    """Scenes whose best prototype is less similar than the best scene's by more are not tried."""
    pnp: PnpOptions = field(default_factory=PnpOptions)
    """RANSAC settings."""
    refine: PnpOptions = field(default_factory=lambda: PnpOptions(threshold_px=3.0))
    """The same once a first pose told where to look among remembered frames."""


@dataclass(frozen=True)
class _Look:
    """What an image has in common with the remembered frames of a scene."""

    matcher: KeyframeMatcher
    votes: Votes


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A pose for one image under the assumption that it shows one scene."""

    scene: int
    camera: Camera
    pose: PnpResult | None
    cells: int
    pixels: np.ndarray
    """(m, 2): the cells once for every source of points."""
    points_m: np.ndarray
    """(m, 3)."""

    @property
    def inliers(self) -> int:
        """Cells with a point that agrees, whatever its source."""
        if self.pose is None:
            return 0
        return int(self.pose.inliers.reshape(-1, self.cells).any(0).sum())


class Localizer:
    """Finds the camera in any of the scenes that a store knows.

    The first image waits until the frames remembered of all scenes are encoded: about a second
    for 60 frames on two cores.

    Args:
        maps: networks, atlas and scene records.
        options: how.
    """

    def __init__(self, maps: SceneMaps, options: LocalizeOptions | None = None):
        self.maps, self.options = maps, options or LocalizeOptions()
        self._view = ViewOptions(short_side=maps.short_side)
        self._prototypes = [record.prototypes.float() for record in maps.scenes]
        self._matchers: dict[int, KeyframeMatcher | None] = {}
        self._lock = Lock()
        for head in maps.heads:
            head.eval()

    @classmethod
    def open(
        cls,
        store: Path | str,
        options: LocalizeOptions | None = None,
        encoder: torch.nn.Module | None = None,
    ) -> Self:
        """A localizer for a store on disk.

        Args:
            store: its folder.
            options: how to locate.
            encoder: only for a store made with a module of one's own: that module.

        Raises:
            InputError: not a store, an empty one, or a damaged file.
        """
        from evercal.mapping.store import Store

        opened = Store.open(Path(store), encoder)
        if not opened.maps.scenes:
            raise InputError(f"store {store}: no scene learned yet; run 'evercal learn' first")
        return cls(opened.maps, options)

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
        features, descriptors = self._encode([self._prepare(image, camera)])
        return self._locate(features[0], descriptors[0], image.shape, camera, began)

    def localize_batch(
        self, images: Sequence[np.ndarray], cameras: Sequence[Camera | None]
    ) -> list[PoseEstimate]:
        """`localize` for many images: encoded several at once, poses found in parallel."""
        answers: dict[int, PoseEstimate] = {}
        views = [self._prepare(image, c) for image, c in zip(images, cameras, strict=True)]
        by_shape: dict[tuple[int, ...], list[int]] = {}
        for i, view in enumerate(views):
            by_shape.setdefault(view.grey.shape, []).append(i)
        with ThreadPoolExecutor(max(1, torch.get_num_threads())) as pool:
            for group in by_shape.values():
                for start in range(0, len(group), ENCODE_BATCH):
                    chunk = group[start : start + ENCODE_BATCH]
                    began = time.perf_counter()
                    features, descriptors = self._encode([views[i] for i in chunk])
                    jobs = [
                        pool.submit(self._locate, f, d, images[i].shape, cameras[i], began)
                        for i, f, d in zip(chunk, features, descriptors, strict=True)
                    ]
                    answers |= {i: job.result() for i, job in zip(chunk, jobs, strict=True)}
        return [answers[i] for i in range(len(images))]

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

    def _encode(self, views: Sequence[View]) -> tuple[Tensor, Tensor]:
        features, descriptors = encode(views, self.maps.encoder, self.maps.descriptor)
        return features.flatten(2).transpose(1, 2), descriptors

    def _locate(
        self,
        features: Tensor,
        descriptor: Tensor,
        shape: tuple[int, ...],
        camera: Camera | None,
        began: float,
    ) -> PoseEstimate:
        best: _Hypothesis | None = None
        cameras = self._cameras(camera, shape)
        usable = [i for i, c in enumerate(cameras) if c is not None]
        matchers = {i: matcher for i in usable if (matcher := self._matcher(i)) is not None}
        looks = {i: _Look(matcher, matcher.retrieve(features)) for i, matcher in matchers.items()}
        for scene in self._candidates(descriptor, usable, looks):
            lens = cameras[scene]
            assert lens is not None
            trial = self._hypothesis(features, descriptor, scene, lens, looks.get(scene))
            own = cameras[trial.scene]
            if own is not None and own != lens:  # the head found another scene: with its camera
                look = looks.get(trial.scene)
                trial = self._hypothesis(features, descriptor, trial.scene, own, look)
            if best is None or trial.inliers > best.inliers:
                best = trial
        assert best is not None
        return self._answer(best, began)

    def _cameras(self, camera: Camera | None, shape: tuple[int, ...]) -> list[Camera | None]:
        """Intrinsics at working size under each scene, None where the proportions do not fit."""
        height, width = shape[:2]
        small = Camera(width, height, 1, 1, 0, 0).short_side_resized(self.maps.short_side)
        found: list[Camera | None] = []
        for record in self.maps.scenes:
            lens = record.query_camera(camera)
            fits = _same_shape(lens, width, height)
            found.append(lens.resized(small.width, small.height) if fits else None)
        if not any(found):
            maps = ", ".join(
                f"{r.name} {r.camera.width}x{r.camera.height}" for r in self.maps.scenes
            )
            raise InputError(
                f"image {width}x{height}: its proportions fit no known camera ({maps}); "
                "give its intrinsics with --camera"
            )
        return found

    def _candidates(
        self, descriptor: Tensor, usable: list[int], looks: dict[int, _Look]
    ) -> list[int]:
        """Scenes to try, the likeliest first."""
        if len(usable) > 1 and len(looks) == len(usable):
            alike = np.stack([looks[i].votes.value for i in usable])
            votes = np.bincount(alike.argmax(0), minlength=len(usable))
            order = np.argsort(-votes, kind="stable")
            enough = self.options.votes * votes.max()
            return [usable[i] for i in order if votes[i] >= enough][: self.options.candidates]
        if self._one_answer():
            return usable[:1]
        likeness = {i: float((self._prototypes[i] @ descriptor).max()) for i in usable}
        usable.sort(key=lambda i: -likeness[i])
        floor = likeness[usable[0]] - self.options.margin
        return [i for i in usable if likeness[i] >= floor][: self.options.candidates]

    def _one_answer(self) -> bool:
        """Whether the head itself decides which scene answers (condition `descriptor`)."""
        return self.maps.heads[0].options.condition == "descriptor" and len(self.maps.heads) == 1

    @torch.inference_mode()
    def _hypothesis(
        self,
        features: Tensor,
        descriptor: Tensor,
        scene: int,
        camera: Camera,
        look: _Look | None,
    ) -> _Hypothesis:
        head, local = self.maps.head_for(scene)
        with autocast():
            output = head(features, local, descriptor.expand(len(features), -1))
        pixels = ideal_cell_pixels(camera, self.maps.encoder.stride).astype(float)
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        own = output.points
        if look is not None:
            pixels = np.tile(pixels, (2, 1))

        def solve(points: Tensor, options: PnpOptions, step: int = 1) -> PnpResult | None:
            some = points[::step].double().numpy()
            return solve_pnp(pixels[::step], some, intrinsics, options)

        if look is None:
            points = own
            pose = solve(points, self.options.pnp)
        else:
            matcher = look.matcher
            found = matcher.match(features, look.votes)
            points = torch.cat([own, matcher.lift(found, own)])
            pose = solve(points, self.options.pnp, FIRST_PASS_STRIDE)
            if pose is not None:
                expected = PosePrior(camera, pose.world_from_camera)
                points = torch.cat([own, matcher.lift(found, own, expected)])
                pose = solve(points, self.options.refine)
        if pose is not None and self._one_answer():
            other = self.maps.atlas().scene_at(pose.world_from_camera.translation_m)
            scene = scene if other is None else other
        return _Hypothesis(scene, camera, pose, len(features), pixels, points.double().numpy())

    def _matcher(self, scene: int) -> KeyframeMatcher | None:
        """The remembered frames of a scene, encoded when they are first needed."""
        with self._lock:
            if scene not in self._matchers:
                matcher = KeyframeMatcher(self.maps, scene) if self._has_depths(scene) else None
                self._matchers[scene] = matcher
            return self._matchers[scene]

    def _has_depths(self, scene: int) -> bool:
        keyframes = self.maps.keyframes[scene]
        return keyframes is not None and bool(keyframes.inverse_depth)

    def _answer(self, best: _Hypothesis, began: float) -> PoseEstimate:
        def answer(status, reason, **found) -> PoseEstimate:
            ms = 1000 * (time.perf_counter() - began)
            ratio = best.inliers / max(best.cells, 1)
            return PoseEstimate(
                status,
                reason,
                found.get("scene"),
                found.get("pose"),
                found.get("covariance"),
                best.inliers,
                ratio,
                ms,
                found.get("pixels"),
                found.get("points"),
            )

        if best.pose is None:
            return answer("failed", "no pose agrees with at least 6 cells of the image")
        found = self.maps.atlas().scene_at(best.pose.world_from_camera.translation_m)
        if found is None or (found != best.scene and not self._one_answer()):
            return answer("failed", "the pose lies outside the cell of its scene")
        record = self.maps.scenes[found]
        ratio = best.inliers / best.cells
        if ratio < record.inlier_threshold:
            need = f"{100 * record.inlier_threshold:.0f} %"
            reason = f"{100 * ratio:.0f} % of the cells agree, {record.name} needs {need}"
            return answer("unknown_scene", reason)
        base_from_atlas = record.cell.atlas_from_base.inverse()
        inliers = best.pose.inliers
        return answer(
            "ok",
            "",
            scene=record.name,
            pose=base_from_atlas @ best.pose.world_from_camera,
            covariance=best.pose.covariance * record.covariance_scale,
            pixels=best.pixels[inliers],
            points=base_from_atlas.apply(best.points_m[inliers]),
        )


def _same_shape(camera: Camera, width: int, height: int) -> bool:
    return abs(camera.width * height / (camera.height * width) - 1) < ASPECT_TOLERANCE
