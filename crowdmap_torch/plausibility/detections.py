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
from torch import Tensor

from crowdmap_torch.geometry.camera import unproject
from crowdmap_torch.plausibility.finding import Finding, Repair
from crowdmap_torch.tables import Rig


@dataclass(frozen=True)
class Outlines:
    """Rows of points as a file has them, before any is refused."""

    px: Float[np.ndarray, "p 2"]
    count: Int[np.ndarray, " n"]
    """Points of each row, one at least."""
    ideal: Float[Tensor, "p 2"] | None = None
    """The points without the lens; None: not known yet."""

    def at(self, px: Float[np.ndarray, "p 2"]) -> Outlines:
        """The same rows with their points elsewhere."""
        return Outlines(px, self.count)


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
    scales: tuple[float, ...] = (4.0, 3.0, 2.5, 2.0, 1.5, 1.25, 0.8, 2 / 3, 0.5, 0.4, 1 / 3, 0.25)
    """Sizes of other images, against the rig's, that are tried."""
    is_box: float = 0.99
    """Share of outlines stored as boxes whose four numbers can be told."""
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
            repair=Repair("scale-pixels", (rig.camera.width, rig.camera.height, 0.0, 0.0)),
        )
        return
    if has_signs and _are_boxes(signs, rig, limits):
        yield Finding(
            "boxes",
            "one corner of most outlines lies in the image's upper left corner",
            "boxes (x, y, width, height) are stored as if they were corners",
            "write the four corners, clockwise: (x, y), (x + w, y), (x + w, y + h), (x, y + h)",
            repair=Repair("boxes") if _can_be_told(signs, limits) else None,
        )
        return
    if has_signs and (share := _crossed(signs, rig, limits)) is not None:
        yield Finding(
            "crossed-corners",
            f"{share:.0%} of the outlines with four corners cross themselves",
            "corners are written row by row: upper left, upper right, lower left, lower right",
            "write them around the outline, clockwise as seen in the image (v down)",
            repair=Repair("uncross-corners"),
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
    sizes = [found for found in better if found[1].kind == "image-size"]
    if len(sizes) > 1:
        better = [found for found in better if found not in sizes]
        better.append(_straightest(sizes, lanes, rig, has_lanes))
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
    sound = _is_inside(signs, rig) & (_fill(signs) > _LEAST_FILL) if has_signs else np.ones(1)
    return _Quality(
        float(sound.mean()), float(_is_on_road(lanes, rig).mean()) if has_lanes else 1.0
    )


def _instead(
    signs: Outlines, lanes: Outlines, rig: Rig, limits: DetectionLimits
) -> Iterator[tuple[Outlines, Outlines, Finding]]:
    """What detections may be instead, each with what it is called."""

    def changed(rows: Outlines, matrix: list[list[float]]) -> Outlines:
        return rows.at(rows.px @ np.array(matrix))

    mirror = [[-1.0, 0.0], [0.0, 1.0]]
    width = rig.camera.width - 1
    # Read backwards an outline is its own mirror image, but for its place.
    turned = changed(signs, mirror)
    yield (
        turned.at(turned.px + _back(signs, width)),
        lanes,
        Finding(
            "anticlockwise",
            "",
            "corners run anticlockwise in the image",
            "write them clockwise as seen in the image (v down)",
            repair=Repair("reverse-corners"),
        ),
    )
    swap = [[0.0, 1.0], [1.0, 0.0]]
    yield (
        changed(signs, swap),
        changed(lanes, swap),
        Finding(
            "swapped-pixels",
            "",
            "u and v are swapped",
            "u runs to the right, v down",
            repair=Repair("swap-pixels"),
        ),
    )
    for scale in limits.scales:
        size = f"{rig.camera.width / scale:.0f} x {rig.camera.height / scale:.0f}"
        yield (
            _scaled(signs, scale),
            _scaled(lanes, scale),
            Finding(
                "image-size",
                "",
                f"pixels are of an image of about {size}",
                f"write them in pixels of the rig's {rig.camera.width} x {rig.camera.height}, or "
                "give the rig the intrinsics of that image",
                repair=Repair("scale-pixels", (scale, scale, (scale - 1) / 2, (scale - 1) / 2)),
            ),
        )


def _scaled(rows: Outlines, scale: float) -> Outlines:
    """Pixels of an image that is so many times as large; the border stays the border."""
    return rows.at((rows.px + 0.5) * scale - 0.5)


def _straightest(
    sizes: list[tuple[_Quality, Finding]], lanes: Outlines, rig: Rig, has_lanes: bool
) -> tuple[_Quality, Finding]:
    """Of several sizes of an image that fit the one under which lane markers are parallel on the road."""
    if not has_lanes:
        quality, finding = max(sizes, key=lambda found: found[0].signs)
        return quality, replace(finding, repair=None)

    def spread(found: tuple[_Quality, Finding]) -> float:
        repair = found[1].repair
        return _spread(_scaled(lanes, repair.numbers[0]), rig) if repair is not None else np.inf

    return min(sizes, key=spread)


def _spread(lanes: Outlines, rig: Rig) -> float:
    """How far the directions of markers on the road differ [rad]: median distance from their median."""
    start = np.cumsum(lanes.count) - lanes.count
    # A marker's ends are enough: it is straight, or all bend alike.
    v = lanes.px[:, 1]
    row = np.repeat(np.arange(len(start)), lanes.count)
    near = np.lexsort((v, row))[start + lanes.count - 1]
    far = np.lexsort((v, row))[start]
    ends = torch.from_numpy(np.stack((lanes.px[near], lanes.px[far])))
    ideal, closes = unproject(rig.camera, ends)
    ray = torch.nn.functional.pad(ideal, (0, 1), value=1.0)
    normal = rig.road_normal_camera.to(ray)
    along = torch.linalg.cross(torch.linalg.cross(ray[0], ray[1], dim=-1), normal[None], dim=-1)
    angle = torch.atan2(along[:, 0], along[:, 2])[closes.all(0)]
    # A direction and its opposite are one.
    angle = (angle + torch.pi / 2) % torch.pi - torch.pi / 2
    return float((angle - angle.median()).abs().median()) if len(angle) else np.inf


def _crossed(signs: Outlines, rig: Rig, limits: DetectionLimits) -> float | None:
    """Which share of the outlines with four corners crosses itself, where these are in rows: upper ones, lower ones."""
    four = np.flatnonzero(signs.count == 4)
    if len(four) < limits.least_rows:
        return None
    start = (np.cumsum(signs.count) - signs.count)[four]
    px = signs.px[start[:, None] + np.arange(4)]
    count = np.full(len(four), 4)
    given = _fill(Outlines(px.reshape(-1, 2), count)) > _LEAST_FILL
    around = Outlines(px[:, [0, 1, 3, 2]].reshape(-1, 2), count)
    fits = (_fill(around) > _LEAST_FILL) & _is_inside(around, rig)
    is_crossed = ~given & fits
    enough = given.mean() < 1 - limits.sound and fits.mean() >= limits.fits
    return float(is_crossed.mean()) if enough else None


_LEAST_FILL = 0.1
"""Area of an outline as a share of its box: less is no outline of a sign, or one that crosses itself."""


def _fill(rows: Outlines) -> Float[np.ndarray, " n"]:
    """Signed area of each row's outline as a share of its box, positive clockwise in the image."""
    start = np.cumsum(rows.count) - rows.count
    extent = np.maximum.reduceat(rows.px, start) - np.minimum.reduceat(rows.px, start)
    return _area(rows) / np.maximum(extent.prod(-1), 1e-9)


def _can_be_told(signs: Outlines, limits: DetectionLimits) -> bool:
    """Whether rows are x, y, w, h written as upper left and lower right corner of an upright box."""
    if (signs.count != 4).any():
        return False
    (x, u1, u2, u3), (y, v1, v2, v3) = signs.px.reshape(-1, 4, 2).transpose(2, 1, 0)
    fits = (x == u3) & (u1 == u2) & (y == v1) & (v2 == v3)
    return bool(fits.mean() >= limits.is_box)


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
    if rows.ideal is None:
        ideal, closes = unproject(rig.camera, torch.from_numpy(rows.px[inside]))
    else:
        # The data set's reader has taken them all: every one closes.
        ideal = rows.ideal[torch.from_numpy(inside)]
        closes = torch.ones_like(ideal[:, 0], dtype=torch.bool)
    ray = torch.nn.functional.pad(ideal, (0, 1), value=1.0)
    # A road normal that points elsewhere is named by itself; a camera's down serves here.
    normal = rig.road_normal_camera.to(ray)
    normal = normal if float(normal[1]) > 0.5 else normal.new_tensor([0.0, 1.0, 0.0])
    below = (ray @ normal > 0) & closes
    found = np.zeros(len(rows.px), dtype=bool)
    found[inside] = below.numpy()
    return found
