"""Poses of an image in one scene: match, PnP, align landmarks, reselect keyframes."""

from dataclasses import replace

from evercal.geometry import SE3, Camera, resize_pixels
from evercal.localization.alignment import SearchedImage, align_pose
from evercal.localization.hypothesis import (
    Aligned,
    Hypothesis,
    Matches,
    Rough,
    accepted,
)
from evercal.localization.intrinsics import FOCAL_FACTORS, IntrinsicsPrior, zoomed
from evercal.localization.keyframe_bank import KeyframeBank
from evercal.localization.matching import Matcher
from evercal.localization.options import LocalizeOptions
from evercal.localization.pnp import PnpResult, most_inliers, solve_pnp, uncertain
from evercal.localization.query import Candidate, Query
from evercal.mapping.scene_map import MapContents
from evercal.typing import Array


class ScenePoses:
    """Estimates poses of images in the scenes of a map."""

    def __init__(
        self, contents: MapContents, bank: KeyframeBank, options: LocalizeOptions
    ):
        self.contents = contents
        self.bank = bank
        self.options = options
        self.matcher = Matcher(bank, options, contents.short_side)

    def hypothesis(
        self, query: Query, candidate: Candidate, matches: Matches | None = None
    ) -> Hypothesis | None:
        """A pose in one scene: match, PnP, align; `matches` are used instead of new ones."""
        scene = candidate.scene
        camera = query.camera(scene).short_side_resized(self.contents.short_side)
        if not matches:
            matches = self.matcher.matches(query, candidate, camera)
        solution = self._solved(query, candidate, matches, camera)
        if not solution:
            return None
        pnp, factor = solution
        count = pnp.inlier_count
        if not self.options.align:
            pixels = matches.pixels[pnp.inliers]
            points = matches.points_m[pnp.inliers]
            pose = uncertain(pixels, points, camera.zoomed(factor), pnp.pose)
            return Rough(
                scene,
                pose,
                pixels,
                points,
                len(pnp.inliers),
                count,
            )
        aligned = self.aligned(query, candidate, pnp.pose, zoomed(factor))
        if not aligned:
            return Rough.unconfirmed(scene, pnp.pose, count)
        aligned = replace(aligned, pnp_inliers=count, matches=matches)
        return self.reselected(query, aligned)

    def _solved(
        self,
        query: Query,
        candidate: Candidate,
        matches: Matches,
        camera: Camera,
    ) -> tuple[PnpResult, float] | None:
        """The PnP pose with the most inliers, and its factor on the focal length."""
        prior = query.priors[candidate.scene]
        unknown = prior.kind == "unknown"
        options = replace(
            self.options.pnp,
            threshold_px=candidate.tolerance * self.options.pnp.threshold_px,
            progressive_sampling=not unknown,
        )
        best = solve_pnp(*matches, camera, options)
        factor = 1.0
        many = best is not None and best.inlier_count >= self.options.aligned_inliers
        if unknown or (many and self._may_be_zoomed(prior, candidate)):
            half = options.max_iterations // 2
            options = replace(options, max_iterations=half)
            cameras = [camera.zoomed(factor) for factor in FOCAL_FACTORS]
            index, other = most_inliers(*matches, cameras, options)
            if not best or (other and other.inlier_count > best.inlier_count):
                best = other
                factor = FOCAL_FACTORS[index]
        if not best:
            return None
        return best, factor

    def _may_be_zoomed(self, prior: IntrinsicsPrior, candidate: Candidate) -> bool:
        """Whether a pose of many inliers that is not final may be due to another focal length.

        Before repeated texture, other poses are the likelier reason.
        """
        if prior.kind != "not stated" or not candidate.thorough:
            return False
        return not len(self.bank.pattern(candidate.keyframes))

    def reselected(self, query: Query, best: Aligned) -> Aligned:
        """The pose by the keyframes that see most of its view, while that raises little support."""
        options = self.options
        while not accepted(best, options.immediate):
            pose = best.pose.pose
            seen = self.bank.seen(best.scene, pose, best.camera)[: options.keyframes]
            candidate = best.candidate._replace(keyframes=seen)
            again = self.aligned(query, candidate, pose, best.change)
            if not again:
                break
            if again.support < options.reselect_gain * best.support:
                break
            best = replace(again, pnp_inliers=best.pnp_inliers, matches=best.matches)
        return best

    def aligned(
        self,
        query: Query,
        candidate: Candidate,
        start: SE3,
        change: Array,
        coarse: bool = True,
    ) -> Aligned | None:
        """A pose map_from_camera, refined by landmarks; see `align_pose`."""
        options = self.options.alignment
        scene = candidate.scene
        landmarks = [self.bank.load(int(k)).landmarks for k in candidate.keyframes]
        image = SearchedImage(query.pyramid, query.camera(scene), query.priors[scene])
        refined = align_pose(
            image,
            landmarks,
            start,
            change,
            options,
            coarse,
        )
        if not refined:
            return None
        observed = refined.observed
        inliers = refined.residual_px < options.inlier_px
        shrink = self.contents.short_side / min(query.grey.shape)
        return Aligned(
            scene=scene,
            pose=refined.pose,
            pixels=resize_pixels(observed.pixels[inliers], shrink),
            points_m=observed.points_m[inliers],
            expected=observed.expected,
            pnp_inliers=0,
            candidate=candidate,
            camera=refined.camera,
            change=refined.change,
            by_intrinsics=refined.by_intrinsics,
            observed=observed,
            measured=refined.measured,
        )

    def slips(self, aligned: Aligned) -> Array:
        """(k, 3) displacements by which an aligned pose may have slipped, the shortest first."""
        return self.bank.pattern(aligned.candidate.keyframes)
