"""Whether detections are outlines in raw pixels of the rig's image, and if not, what they are instead.

Most faults of an outline drop its row at the door. Where that happens to most rows, or where lane points lie above the
horizon, the file as a whole is tried as what it is usually mistaken for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int

from crowdmap_torch.geometry.camera import unproject
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.tables import Rig


@dataclass(frozen=True)
class Outlines:
    """Rows of points as a file has them, before any is refused."""

    px: Float[np.ndarray, "p 2"]
    count: Int[np.ndarray, " n"]
    """Points of each row, one at least."""


@dataclass(frozen=True)
class DetectionLimits:
    """From when on detections are looked at, and what is still usual."""

    least_rows: int = 30
    """Rows of a file from which something is concluded."""
    sound: float = 0.6
    """Share of the sign rows that are clockwise and in the image."""
    fits: float = 0.85
    """Share that what they may be instead has to reach."""
    ground: float = 0.6
    """Share of the lane points that lie on the road: in the image and below the horizon."""
    scales: tuple[float, ...] = (2.0, 4.0, 1.5, 3.0, 0.5, 0.25)
    """Sizes of other images, against the rig's, that are tried."""
    box_corner: float = 0.15
    """A corner this near to the image's own, as a share of it, is no corner but a width and a height."""
    box_extent: float = 0.25
    """... where outlines reach over so much of the image."""


def detection_findings(
    signs: Outlines, lanes: Outlines, rig: Rig, limits: DetectionLimits | None = None
) -> Iterator[Finding]:
    """What is wrong with a journey's detections as a whole."""
    limits = limits or DetectionLimits()
    has_signs, has_lanes = (len(rows.count) >= limits.least_rows for rows in (signs, lanes))
    rows = [rows for rows, has in ((signs, has_signs), (lanes, has_lanes)) if has]
    if not rows:
        return
    if max(float(np.abs(r.px).max()) for r in rows) <= 1.01:
        yield Finding(
            "unit-pixels",
            "all pixels of detections lie between 0 and 1",
            "they are shares of the image's width and height",
            f"multiply u by {rig.camera.width} and v by {rig.camera.height}",
        )
        return
    if has_signs and _are_boxes(signs, rig, limits):
        yield Finding(
            "boxes",
            "one corner of most outlines lies in the image's upper left corner",
            "boxes (x, y, width, height) are stored as if they were corners",
            "write the four corners, clockwise: (x, y), (x + w, y), (x + w, y + h), (x, y + h)",
        )
        return
    given = _quality(signs, lanes, rig, has_signs, has_lanes)
    if given.signs >= limits.sound and given.lanes >= limits.ground:
        return
    tried = [
        (_quality(s, lane, rig, has_signs, has_lanes), finding)
        for s, lane, finding in _instead(signs, lanes, rig, limits)
    ]
    better = [(q, finding) for q, finding in tried if min(q.signs, q.lanes) >= limits.fits]
    evidence = (
        f"{given.signs:.0%} of the outlines are clockwise and in the image"
        if given.signs < limits.sound
        else f"{given.lanes:.0%} of the lane points lie in the image and below the horizon"
    )
    if better:
        _, finding = max(better, key=lambda found: found[0].signs + found[0].lanes)
        yield replace(finding, evidence=evidence)
    else:
        yield Finding(
            "detections",
            evidence,
            "detections, camera and road calibration do not fit each other",
            "pixels are raw pixels of the rig's image, (0, 0) the centre of the top-left one; "
            "corners are clockwise in the image",
        )


@dataclass(frozen=True)
class _Quality:
    """Shares of what is as it should be; 1 where there is nothing to judge."""

    signs: float
    lanes: float


def _quality(
    signs: Outlines, lanes: Outlines, rig: Rig, has_signs: bool, has_lanes: bool
) -> _Quality:
    sound = _is_inside(signs, rig) & (_area(signs) > 0) if has_signs else np.ones(1)
    return _Quality(
        float(sound.mean()), float(_is_on_road(lanes, rig).mean()) if has_lanes else 1.0
    )


def _instead(
    signs: Outlines, lanes: Outlines, rig: Rig, limits: DetectionLimits
) -> Iterator[tuple[Outlines, Outlines, Finding]]:
    """What detections may be instead, each with what it is called."""

    def changed(rows: Outlines, matrix: list[list[float]]) -> Outlines:
        return replace(rows, px=rows.px @ np.array(matrix))

    mirror = [[-1.0, 0.0], [0.0, 1.0]]
    width = rig.camera.width - 1
    # Read backwards an outline is its own mirror image, but for its place.
    turned = changed(signs, mirror)
    yield (
        replace(turned, px=turned.px + _back(signs, width)),
        lanes,
        Finding(
            "anticlockwise",
            "",
            "corners run anticlockwise in the image",
            "write them clockwise as seen in the image (v down)",
        ),
    )
    swap = [[0.0, 1.0], [1.0, 0.0]]
    yield (
        changed(signs, swap),
        changed(lanes, swap),
        Finding("swapped-pixels", "", "u and v are swapped", "u runs to the right, v down"),
    )
    for scale in limits.scales:
        size = f"{rig.camera.width / scale:.0f} x {rig.camera.height / scale:.0f}"
        larger = [[scale, 0.0], [0.0, scale]]
        yield (
            changed(signs, larger),
            changed(lanes, larger),
            Finding(
                "image-size",
                "",
                f"pixels are of an image of about {size}",
                f"write them in pixels of the rig's {rig.camera.width} x {rig.camera.height}, or "
                "give the rig the intrinsics of that image",
            ),
        )


def _back(rows: Outlines, width: float) -> Float[np.ndarray, "p 2"]:
    """What brings mirrored rows back to where they were."""
    start = np.cumsum(rows.count) - rows.count
    u = rows.px[:, 0]
    both = np.minimum.reduceat(u, start) + np.maximum.reduceat(u, start)
    return np.stack((np.repeat(both, rows.count), np.zeros(len(u))), axis=-1)


def _are_boxes(signs: Outlines, rig: Rig, limits: DetectionLimits) -> bool:
    start = np.cumsum(signs.count) - signs.count
    size = np.array([rig.camera.width, rig.camera.height])
    low, high = (reduce.reduceat(signs.px, start) / size for reduce in (np.minimum, np.maximum))
    middle_low, extent = np.median(low, axis=0), np.median(high - low, axis=0)
    return bool((middle_low < limits.box_corner).all() and extent.max() > limits.box_extent)


def _is_inside(rows: Outlines, rig: Rig) -> np.ndarray:
    """By row, whether all its points lie in the image."""
    outside = ~_in_image(rows.px, rig)
    return np.add.reduceat(outside, np.cumsum(rows.count) - rows.count) == 0


def _in_image(px: Float[np.ndarray, "p 2"], rig: Rig) -> np.ndarray:
    size = np.array([rig.camera.width, rig.camera.height])
    return np.logical_and.reduce((px >= -0.5) & (px <= size - 0.5), axis=-1)


def _area(rows: Outlines) -> Float[np.ndarray, " n"]:
    """Signed area of each row's outline, positive clockwise in the image."""
    start = np.cumsum(rows.count) - rows.count
    following = np.arange(len(rows.px)) + 1
    last = start + rows.count - 1
    following[last] = start
    (x, y), (x1, y1) = rows.px.T, rows.px[following].T
    return np.add.reduceat(x * y1 - x1 * y, start) / 2


def _is_on_road(rows: Outlines, rig: Rig) -> np.ndarray:
    """By point, whether it lies in the image and below the horizon of the calibrated road."""
    inside = _in_image(rows.px, rig)
    ideal, closes = unproject(rig.camera, torch.from_numpy(rows.px[inside]))
    ray = torch.nn.functional.pad(ideal, (0, 1), value=1.0)
    # A road normal that points elsewhere is named by itself; a camera's down serves here.
    normal = rig.road_normal_camera.to(ray)
    normal = normal if float(normal[1]) > 0.5 else normal.new_tensor([0.0, 1.0, 0.0])
    below = (ray @ normal > 0) & closes
    found = np.zeros(len(rows.px), dtype=bool)
    found[inside] = below.numpy()
    return found
