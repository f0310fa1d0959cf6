"""Journeys that are one drive uploaded more than once, whole or cut, told by what was detected in them.

No two drives have the same outlines in their images: noise alone moves each of them. Names, times, frame numbers and
even poses of copies may differ, and coordinates may have been rounded; the pixels stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from crowdmap_torch.tables import Journey

SAME_PX = 0.06
"""Boxes that differ by less are one: a coordinate rounded to a tenth of a pixel is off by 0.05."""
COPY_SHARE = 0.5
"""A journey with more of its boxes in another one repeats more than it adds: it is a copy, or was cut out of the other."""
_LEAST_SHARE = 0.05
"""Less of a journey in another one may be chance, where outlines are in whole pixels."""
_SAMPLES = 64
"""Boxes of each journey that are looked for in all others before two are compared as a whole."""
_LEAST_SPREAD_PX = 100 * SAME_PX
"""Pixels that all lie within less are none, and boxes of any two drives are the same to `SAME_PX`."""
_LANE_PX = 1e6
"""What keeps boxes of lane markers away from those of signs."""


@dataclass(frozen=True)
class Overlap:
    """How much of a journey is in another one, which has at least as many detections."""

    journey: int
    other: int
    share: float
    """Of the journey's detections."""


def overlaps(journeys: Sequence[Journey]) -> tuple[Overlap, ...]:
    """Journeys with detections in common, each with the one that has most of its own among those that stay.

    Of two the one with more detections stays, of equals the first.
    """
    boxes = [
        _boxes(journey) if _spread(journey) > _LEAST_SPREAD_PX else _NO_BOX for journey in journeys
    ]
    count = np.array([len(own) for own in boxes], dtype=np.int64)
    if not count.sum():
        return ()
    everywhere = KDTree(np.concatenate(boxes))
    owner = np.repeat(np.arange(len(boxes)), count)
    stays: dict[int, KDTree] = {}
    found = []
    for number in np.argsort(-count, kind="stable").tolist():
        own = boxes[number]
        if not len(own):
            break
        some = own[:: -(-len(own) // _SAMPLES)]
        hits = np.zeros(len(boxes))
        for rows in everywhere.query_ball_point(some, SAME_PX, p=np.inf):
            hits[np.unique(owner[rows])] += 1
        shares = [
            (
                float(
                    np.isfinite(tree.query(own, p=np.inf, distance_upper_bound=SAME_PX)[0]).mean()
                ),
                other,
            )
            for other, tree in stays.items()
            if hits[other] >= _LEAST_SHARE * len(some)
        ]
        share, other = max(shares, default=(0.0, -1), key=lambda pair: (pair[0], -pair[1]))
        if share >= _LEAST_SHARE:
            found.append(Overlap(number, other, share))
        if share < COPY_SHARE:
            stays[number] = KDTree(own)
    return tuple(sorted(found, key=lambda overlap: overlap.journey))


def copies(journeys: Sequence[Journey]) -> tuple[Overlap, ...]:
    """Journeys to leave out so that every drive counts once, each with the one that stays."""
    return tuple(overlap for overlap in overlaps(journeys) if overlap.share >= COPY_SHARE)


def common_frames(journey: Journey, other: Journey) -> Int[np.ndarray, " k"]:
    """Frames of a journey, by row, from the first to the last with a detection that is in another one too."""
    tree = KDTree(_boxes(other))
    boxes = _all_boxes(journey)
    there = np.isfinite(tree.query(boxes, p=np.inf, distance_upper_bound=SAME_PX)[0])
    frame = torch.cat((journey.signs.frame, journey.lanes.frame)).cpu().numpy()[there]
    return np.arange(frame.min(), frame.max() + 1) if len(frame) else frame


_NO_BOX = np.zeros((0, 4))


def _spread(journey: Journey) -> float:
    """Over how much of the image a journey's detections reach [px]."""
    px = torch.cat((journey.signs.corners_px.flatten(0, 1), journey.lane_points.px))
    return float((px.amax(0) - px.amin(0)).max()) if len(px) else 0.0


def _boxes(journey: Journey) -> Float[np.ndarray, "b 4"]:
    """Boxes of all outlines and lane markers [px], those of a car that stands still once."""
    return np.unique(_all_boxes(journey), axis=0)


def _all_boxes(journey: Journey) -> Float[np.ndarray, "d 4"]:
    """A box for each outline, then for each lane marker [px]."""
    corners = journey.signs.corners_px
    signs = torch.cat((corners.amin(1), corners.amax(1)), dim=1)
    point, n = journey.lane_points.px, len(journey.lanes)
    rows = journey.lane_points.detection[:, None].expand_as(point)
    low, high = (
        point.new_zeros(n, 2).scatter_reduce(0, rows, point, which, include_self=False)
        for which in ("amin", "amax")
    )
    lanes = torch.cat((low, high), dim=1) + _LANE_PX
    return torch.cat((signs, lanes)).cpu().numpy()
