"""Rivals of a pose: other poses of the same scene that explain the image as well."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from evercal.localization.acceptance import APART_SIGMAS, FULL_SUPPORT
from evercal.localization.answer import differ
from evercal.localization.hypothesis import Aligned, accepted
from evercal.localization.intrinsics import FOCAL_FACTORS, zoomed
from evercal.localization.pnp import most_inliers
from evercal.localization.query import Query
from evercal.localization.repetition import displaced
from evercal.localization.scene_poses import ScenePoses

_NEXT_FOCAL = 0.09
"""Half of the step between `FOCAL_FACTORS`, logarithm."""

_TOLERANCE = 2.5
"""Factor on the threshold of RANSAC for rivals of a pose with little support."""


def settled(
    poses: ScenePoses, query: Query, best: Aligned
) -> tuple[Aligned, Aligned | None]:
    """The strongest pose among an accepted one and its rivals, and the runner-up.

    Without a runner-up that explains the image nearly as well, the second value is None.
    """
    clear = poses.options.clear_strength
    candidates = _climbed(poses, query, best)
    if len(candidates) == 1:
        return best, None
    strongest = max(candidates, key=lambda rival: _strength(poses, rival, best))
    if _strength(poses, strongest, best) * clear > 1:
        best = strongest
    runner_up = None
    highest = clear
    for rival in candidates:
        if rival is best or not differ(best, rival.pose.pose):
            continue
        strength = _strength(poses, rival, best)
        if strength > highest:
            runner_up = rival
            highest = strength
    return best, runner_up


def _climbed(poses: ScenePoses, query: Query, best: Aligned) -> list[Aligned]:
    """An accepted pose and its rivals.

    The true pose may be several periods of a pattern away. So the rivals of the rival with the most
    support are tried, too, while the support rises.
    """
    candidates = [best]
    front = best
    for _ in range(poses.options.climbs):
        rivals = [rival for rival in _rivals(poses, query, front) if accepted(rival)]
        candidates += rivals
        higher = max(rivals, key=lambda rival: rival.support, default=front)
        if higher.support <= front.support:
            break
        front = higher
    return candidates


def _strength(poses: ScenePoses, rival: Aligned, best: Aligned) -> float:
    """How well a rival explains the image, relative to another pose.

    The ratio of their support times that of the matches within one cell. Landmarks distinguish
    a square of a board from the next one; racks of one kind differ only in their surroundings.
    """
    ratio = rival.support / max(best.support, 1e-9)
    if not len(best.matches.pixels):
        return ratio
    of_rival = _agreeing(poses, rival, best)
    return ratio * of_rival / max(_agreeing(poses, best, best), 1)


def _agreeing(poses: ScenePoses, pose: Aligned, best: Aligned) -> int:
    """Number of matches of the best pose that agree with another one."""
    camera = pose.camera.short_side_resized(poses.contents.short_side)
    stride = poses.contents.encoder.stride
    outliers = best.matches.beside(camera, pose.pose.pose, stride)
    return len(best.matches.pixels) - len(outliers.pixels)


def _rivals(poses: ScenePoses, query: Query, best: Aligned) -> Iterator[Aligned]:
    """Other poses in the same scene.

    Repeated texture matches in several places. So the matches that a pose leaves over may agree
    on another one, and the pose may have slipped by a step of the pattern.
    """
    camera = best.camera.short_side_resized(poses.contents.short_side)
    pose = best.pose.pose
    candidate = best.candidate
    matches = best.matches
    if not accepted(best, poses.options.immediate):
        candidate = candidate._replace(stride=1, tolerance=_TOLERANCE)
        matches = poses.matcher.matches(query, candidate, camera)
    rest = matches.beside(camera, pose, poses.options.rival_px)
    if len(rest.pixels) >= poses.options.aligned_inliers:
        left_over = poses.hypothesis(query, candidate, rest)
        if isinstance(left_over, Aligned):
            yield replace(left_over, matches=best.matches)
    stated = query.priors[best.scene].kind not in ("unknown", "not stated")
    deviation = float(np.sqrt(best.measured[0, 0]))
    undecided = APART_SIGMAS * deviation > _NEXT_FOCAL
    if not stated and undecided and best.support < FULL_SUPPORT:
        yield from _other_focal_lengths(poses, query, best)
    for step in poses.slips(best):
        start = displaced(pose, step)
        rival = poses.aligned(query, best.candidate, start, best.change, coarse=False)
        if rival:
            yield replace(rival, matches=best.matches, pnp_inliers=best.pnp_inliers)


def _other_focal_lengths(
    poses: ScenePoses, query: Query, best: Aligned
) -> Iterator[Aligned]:
    """The pose that starts at the best of other focal lengths.

    Before a flat surface a longer focal length looks like a smaller distance.
    """
    camera = query.cameras[best.scene].short_side_resized(poses.contents.short_side)
    # As many inliers are sought as at the focal length of the pose.
    options = replace(poses.options.pnp, sought_inliers=best.pnp_inliers)
    factors = []
    for factor in (1.0, *FOCAL_FACTORS):
        if abs(zoomed(factor)[0] - best.change[0]) > _NEXT_FOCAL:
            factors.append(factor)
    cameras = [camera.zoomed(factor) for factor in factors]
    index, pnp = most_inliers(*best.matches, cameras, options)
    if not pnp or pnp.inlier_count < best.pnp_inliers:
        return
    change = zoomed(factors[index])
    rival = poses.aligned(query, best.candidate, pnp.pose, change)
    if rival:
        yield replace(rival, matches=best.matches, pnp_inliers=best.pnp_inliers)
