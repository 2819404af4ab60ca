"""Rivals of a pose: other poses of the same scene that explain the image as well."""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from evercal.geometry import SE3, Camera
from evercal.localization.acceptance import FULL_SUPPORT, accepted, differ, support
from evercal.localization.intrinsics import FOCAL_FACTORS, NOT_STATED, UNKNOWN, zoomed
from evercal.localization.pnp import solve_pnp
from evercal.localization.query import Hypothesis, Query
from evercal.localization.repetition import displaced

_NEXT_FOCAL = 0.09
"""Half of the step between `FOCAL_FACTORS`, logarithm."""

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer


def settled(
    localizer: "Localizer", query: Query, best: Hypothesis, camera: Camera
) -> tuple[Hypothesis, Hypothesis | None]:
    """The strongest pose among an accepted one and its rivals, and the runner-up.

    Without a runner-up that explains the image nearly as well, the second value is None.
    """
    options = localizer.options
    seen = [best]
    front = best
    for _ in range(options.climbs):
        rivals = [
            rival
            for rival in _rivals(localizer, query, front, camera)
            if rival.refined and rival.pose and accepted(rival)
        ]
        seen += rivals
        higher = max(rivals, key=support, default=front)
        if support(higher) <= support(front):
            break
        front = (
            higher  # several periods away, the way leads over poses of rising support
        )
    if len(seen) == 1:
        return best, None
    strongest = max(seen, key=lambda rival: _strength(localizer, rival, best))
    if _strength(localizer, strongest, best) * options.clear_strength > 1:
        best = strongest
    others = [x for x in seen if x.pose and x is not best and differ(best, x.pose.pose)]
    runner_up = max(
        others, key=lambda rival: _strength(localizer, rival, best), default=None
    )
    if (
        runner_up is None
        or _strength(localizer, runner_up, best) <= options.clear_strength
    ):
        return best, None
    return best, runner_up


def _strength(localizer: "Localizer", rival: Hypothesis, best: Hypothesis) -> float:
    """How well a rival explains the image, relative to another pose; both are aligned.

    The ratio of their support times that of the matches within one cell. Landmarks distinguish
    a square of a board from the next one; racks of one kind differ only in their surroundings.
    """
    contents = localizer.contents
    ratio = support(rival) / max(support(best), 1e-9)
    if best.matches is None:
        return ratio
    agreeing = []
    for pose in (rival.refined, best.refined):
        if pose is None:  # without alignment there are no rivals
            return ratio
        small = pose.camera.short_side_resized(contents.short_side)
        rest = best.matches.beside(small, pose.pose.pose, contents.encoder.stride)
        agreeing.append(len(best.matches.pixels) - len(rest.pixels))
    return ratio * agreeing[0] / max(agreeing[1], 1)


def _rivals(
    localizer: "Localizer", query: Query, best: Hypothesis, camera: Camera
) -> Iterator[Hypothesis]:
    """Other poses in the same scene.

    Repeated texture matches in several places. So the matches that a pose leaves over may agree
    on another one, and the pose may have slipped by a step of the pattern.
    """
    if best.pose is None or best.refined is None or best.candidate is None:
        return
    pose = best.pose.pose
    change = best.refined.change
    if best.matches is not None:
        small = best.refined.camera.short_side_resized(localizer.contents.short_side)
        rest = best.matches.beside(small, pose, localizer.options.rival_px)
        if len(rest.pixels) >= localizer.options.aligned_inliers:
            left_over = localizer.hypothesis(query, best.candidate, camera, rest)
            yield replace(left_over, matches=best.matches)
    stated = query.priors[best.scene] not in (UNKNOWN, NOT_STATED)
    if not stated and support(best) < FULL_SUPPORT:
        yield from _other_focal_lengths(localizer, query, best, camera)
    for step in localizer.slips(best):
        start = displaced(pose, step)
        rival = localizer.aligned(query, best.candidate, camera, start, change, False)
        if rival is not None:
            yield replace(rival, matches=best.matches, pnp_inliers=best.pnp_inliers)


def _other_focal_lengths(
    localizer: "Localizer", query: Query, best: Hypothesis, camera: Camera
) -> Iterator[Hypothesis]:
    """The pose that starts at the best of other focal lengths.

    Before a flat surface a longer focal length looks like a smaller distance.
    """
    if best.matches is None or best.refined is None or best.candidate is None:
        return
    small = camera.short_side_resized(localizer.contents.short_side)
    # As many inliers are wanted as at the focal length of the pose.
    options = replace(localizer.options.pnp, wanted=best.pnp_inliers)
    poses = []
    for factor in (1.0, *FOCAL_FACTORS):
        change = zoomed(factor)
        if abs(change[0] - best.refined.change[0]) > _NEXT_FOCAL:
            pnp = solve_pnp(*best.matches, small.zoomed(factor), options)
            poses += [(int(pnp.inliers.sum()), factor, pnp.pose)] if pnp else []
    inliers, factor, pose = max(
        poses, default=(0, 1.0, SE3.identity()), key=lambda found: found[0]
    )
    if inliers >= best.pnp_inliers:
        rival = localizer.aligned(query, best.candidate, camera, pose, zoomed(factor))
        if rival is not None:
            yield replace(rival, matches=best.matches, pnp_inliers=best.pnp_inliers)
