"""Landmarks that are still where an earlier pose of the camera saw them.

If camera and scene moved against each other as a whole, none is, but for chance. If a table with
all on it was pushed before a fixed camera, those of the room are.
"""

import numpy as np

from evercal.geometry import SE3, Camera, norms
from evercal.localization.alignment import SearchedImage, matches_at
from evercal.localization.localizer import Localizer
from evercal.mapping.scene_map import SceneMap
from evercal.typing import Array, Image

NEAR_PX = 0.5
"""Distance of a landmark that did not move from its place, pixels at working size."""
MOVED_PX = 6.0
"""Only landmarks that the motion of the camera would move by more than this count, pixels."""
LEAST_SHARE = 0.05
"""Smallest share of the landmarks that did not move; chance has 2 %."""
DENSER = 25.0
"""Smallest density of matches within NEAR_PX, in densities of those from 1 px on. After motions of
the camera it is 4 to 20, before a moved table 50."""


def unmoved(
    localizer: Localizer,
    image: Image,
    camera: Camera | None,
    scene: SceneMap,
    then: SE3,
    now: SE3,
) -> float:
    """Share of the landmarks that stayed where a camera at `then` saw them; 0 if by chance.

    Both poses are base_from_camera.
    """
    query = localizer.query(image, camera)
    number = localizer.contents.names.index(scene.name)
    start = scene.frame.from_base(then)
    bank = localizer.poses.bank
    seen = bank.seen(number, start, query.cameras[number])
    seen = seen[: localizer.options.keyframes]
    searched = SearchedImage(query.pyramid, query.camera(number), query.priors[number])
    landmarks = [bank.load(int(k)).landmarks for k in seen]
    observed = matches_at(searched, landmarks, start, localizer.options.alignment)
    if not observed:
        return 0.0
    place = searched.camera.project(start.inverse().apply(observed.points_m))
    other = scene.frame.from_base(now).inverse().apply(observed.points_m)
    moves = ~(norms(searched.camera.project(other) - place) < MOVED_PX)
    away = norms(place - observed.pixels)[moves]
    share = np.count_nonzero(away < NEAR_PX) / observed.expected
    return share if share > LEAST_SHARE and _dense(away) else 0.0


def _dense(away_px: Array) -> bool:
    """Whether distances (n,) cluster near zero."""
    most = away_px.max(initial=0.0)
    far = np.count_nonzero(away_px > 1) / max(most**2 - 1, 1.0)
    return np.count_nonzero(away_px < NEAR_PX) / NEAR_PX**2 > DENSER * far
