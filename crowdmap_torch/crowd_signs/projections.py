"""Signs of the map beside the detections of a journey, in the image: candidates, and how far detections lie off them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.neighbours import cross_pairs
from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.optim.robust import median_along
from crowdmap_torch.tables import Association, Journey, Rows, SignDetections, Signs


@dataclass(frozen=True)
class Candidates(Rows):
    """Pairs of a detection and a sign that its camera may see."""

    row: Int[Tensor, " p"]
    """Detection of the journey."""
    sign: Int[Tensor, " p"]
    px: Float[Tensor, "p 8 2"]
    """Projected corners."""
    size: Float[Tensor, " p"]
    """Larger side of their box [px]."""


@dataclass(frozen=True)
class ProjectionErrors:
    """How the projections of signs err, from detections nearby in time."""

    offset_px: Float[Tensor, "p 2"]
    """Of the detections from the projection; zero where nothing tells."""
    is_known: Bool[Tensor, " p"]
    is_between: Bool[Tensor, " p"]
    """The sign is seen before and after."""
    is_shown: Bool[Tensor, " p"]
    """Another detection of the frame shows the sign."""
    usual_px: Float[Tensor, ""]
    """How far most corners are off where the detection before tells how the projection errs, of half of the detections that
    show a sign; zero where none follows another."""


def candidates_of(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    signs: Signs,
    row: Int[Tensor, " q"],
    sign: Int[Tensor, " q"],
) -> Candidates:
    """Of pairs of a detection and a sign, those whose sign faces the camera and projects into its image."""
    T = pose[journey.signs.frame[row]]
    ray = signs.center_world[sign] - T[:, :3, 3]
    faces = (ray * signs.normal_world[sign]).sum(1) < 0
    row, sign = row[faces], sign[faces]
    px, is_seen = _projected(journey, T[faces], signs, sign)
    _, extent = box(px)
    return Candidates(row, sign, px, extent.amax(1))[is_seen]


def candidates_nearby(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    signs: Signs,
    association: Association,
    *,
    reach_m: float,
    count: int,
    first: int = 0,
) -> Candidates:
    """Detections that show no sign yet, each with the up to `count` nearest signs within reach of its camera.

    Of the signs those from the row `first` on.
    """
    rows = torch.nonzero(association.sign < 0)[:, 0]
    position = pose[journey.signs.frame[rows], :3, 3]
    at, sign = cross_pairs(position, signs.center_world[first:], radius=reach_m, count=count).T
    return candidates_of(journey, pose, signs, rows[at], first + sign)


def projection_errors(
    journey: Journey,
    pose: Float[Tensor, "f 4 4"],
    signs: Signs,
    association: Association,
    pairs: Candidates,
    *,
    window_s: float,
) -> ProjectionErrors:
    """How the projection of each pair errs, between the nearest detections of its sign before and after.

    Detections that are further than `window_s` [s] from that of the pair tell nothing.
    """
    detections = journey.signs
    rows = torch.nonzero(association.sign >= 0)[:, 0]
    rows = rows[detections.shape[rows] == signs.shape[association.sign[rows]]]
    sign = association.sign[rows]
    px, _ = _projected(journey, pose[detections.frame[rows]], signs, sign)
    count = polygon.corner_count(signs.shape[sign])
    corners = polygon.roll(detections.corners_px[rows], association.sign_shift[rows], count)

    t = journey.t_ns - journey.t_ns[:1]
    window = round(1e9 * window_s)
    span = int(t[-1:].sum()) + 2 * window + 1  # signs are further apart than any window
    key = sign * span + t[detections.frame[rows]]
    asked = pairs.sign * span + t[detections.frame[pairs.row]]
    order = key.argsort(stable=True)
    key, off, count = key[order], (corners - px)[order], count[order]
    error = _median_of_corners(off, count)
    follows = key[1:] - key[:-1] <= window
    way = _reach_of_most((off[1:] - error[:-1, None])[follows].norm(dim=2), count[1:][follows])
    # An error before and one behind all others, too far from anything to tell.
    beyond = key.new_tensor([-1 - window, len(signs) * span + window])
    key = torch.cat((beyond[:1], key, beyond[1:]))
    error = torch.nn.functional.pad(error, (0, 0, 1, 1))
    after = torch.searchsorted(key, asked)
    before = torch.searchsorted(key, asked, right=True) - 1
    way_after, way_before = key[after] - asked, asked - key[before]
    has_after, has_before = way_after <= window, way_before <= window
    between = way_before / (way_before + way_after).clamp_min(1)
    share = torch.where(has_after & has_before, between, has_after.to(error))
    offset = torch.lerp(error[before], error[after], share[:, None].to(error))
    is_known = has_after | has_before
    return ProjectionErrors(
        offset_px=torch.where(is_known[:, None], offset, 0.0),
        is_known=is_known,
        is_between=has_after & has_before,
        is_shown=way_after == 0,
        usual_px=median_along(way, 0) if len(way) else way.sum(),
    )


def misfit_px(
    detections: SignDetections, signs: Signs, pairs: Candidates, offset_px: Float[Tensor, "p 2"]
) -> tuple[Float[Tensor, " p"], Int[Tensor, " p"]]:
    """Distance within which most corners lie of the projected ones [px], and the shift of the corners that brings them.

    Outlines of different shapes are compared by their boxes.
    """
    shape = signs.shape[pairs.sign]
    seen, expected = detections.corners_px[pairs.row], pairs.px + offset_px[:, None]
    count = polygon.corner_count(shape)
    rank = torch.arange(polygon.MAX_CORNERS, device=count.device)
    misfits = []
    for shift in rank:
        way = (polygon.roll(seen, shift.expand_as(count), count) - expected).norm(dim=2)
        misfits.append(_reach_of_most(way, count).masked_fill(shift >= count, torch.inf))
    misfit, shift = torch.stack(misfits, dim=1).min(1)
    (centre, extent), (other_centre, other_extent) = box(seen), box(expected)
    by_box = torch.maximum(
        (centre - other_centre).norm(dim=1), (extent - other_extent).abs().amax(1) / 2
    )
    alike = detections.shape[pairs.row] == shape
    return torch.where(alike, misfit, by_box), shift.masked_fill(~alike, 0)


def box(px: Float[Tensor, "p 8 2"]) -> tuple[Float[Tensor, "p 2"], Float[Tensor, "p 2"]]:
    """Centre and extent of the box around each outline [px]; padded slots repeat a corner."""
    low, high = px.amin(1), px.amax(1)
    return (low + high) / 2, high - low


def _median_of_corners(
    off: Float[Tensor, "n 8 2"], count: Int[Tensor, " n"]
) -> Float[Tensor, "n 2"]:
    """By axis the median of so many corners; padded slots count nothing."""
    ranked = _ranked_corners(off.mT, count[:, None])
    middle = torch.stack(((count - 1) // 2, count // 2), dim=1)
    return ranked.gather(2, middle[:, None].expand(-1, 2, -1)).mean(2)


def _reach_of_most(way: Float[Tensor, "n 8"], count: Int[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The distance within which most of so many corners lie."""
    return _ranked_corners(way, count).gather(1, count[:, None] // 2)[:, 0]


def _ranked_corners(
    value: Float[Tensor, "*n 8"], count: Int[Tensor, "*#n"]
) -> Float[Tensor, "*n 8"]:
    """Values of corners in order; behind so many there is infinity."""
    is_padded = torch.arange(polygon.MAX_CORNERS, device=count.device) >= count[..., None]
    return value.masked_fill(is_padded, torch.inf).sort(-1).values


def _projected(
    journey: Journey, T_world_camera: Float[Tensor, "p 4 4"], signs: Signs, sign: Int[Tensor, " p"]
) -> tuple[Float[Tensor, "p 8 2"], Bool[Tensor, " p"]]:
    """Corners of signs in the image, and whether the camera sees most of them."""
    corner = signs.corners_world[sign]
    px, visible = camera.project(
        journey.rig.camera, se3.transform(se3.inverse(T_world_camera)[:, None], corner)
    )
    return px, visible.sum(1) > visible.shape[1] // 2
