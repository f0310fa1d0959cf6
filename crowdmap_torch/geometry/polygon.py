"""Sign outlines: their corners, and how two lists of corners correspond (IV-A, IV-B).

A sign's own plane has x to the right and y up as the driver sees it, z towards the driver; the
origin is the mean of the corners. Corners are listed clockwise as the driver sees them, from the
top-left one (of two top corners the left one; polygons with a corner at the top: there). Every list
has `MAX_CORNERS` slots; those past the shape's number repeat the last corner.

Everything that knows a sign's outline is here: round plates (a curve instead of corners) would be a
further kind of shape.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import plane, se3

_CUT = 0.5 - (1 - math.sqrt(0.5))
"""Half the side of an octagon of width 1: corners at 0.2929 and 0.7071 of the box's sides."""
_BOX_CORNERS = {
    "triangle": ((0, 0.5), (0.5, -0.5), (-0.5, -0.5)),
    "inverted_triangle": ((-0.5, 0.5), (0.5, 0.5), (0, -0.5)),
    "rectangle": ((-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)),
    "diamond": ((0, 0.5), (0.5, 0), (0, -0.5), (-0.5, 0)),
    "pentagon": ((0, 0.5), (0.5, 0), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0)),
    "octagon": (
        *((-_CUT, 0.5), (_CUT, 0.5), (0.5, _CUT), (0.5, -_CUT)),
        *((_CUT, -0.5), (-_CUT, -0.5), (-0.5, -_CUT), (-0.5, _CUT)),
    ),
}
"""Corners of each shape in a box of width and height 1 around the origin, symmetric about one of its axes at least."""
SHAPES = tuple(_BOX_CORNERS)
TRIANGLE, INVERTED_TRIANGLE, RECTANGLE, DIAMOND, PENTAGON, OCTAGON = range(6)
MAX_CORNERS = 8
CORNER_COUNT = torch.tensor([len(corners) for corners in _BOX_CORNERS.values()])
"""Corners of each shape."""
_DRAWN_PX = 2e-3
"""Corners that are that near to where a shape has them in a box were drawn there [px]."""
_REGULAR_TOLERANCE = 0.02
"""If width and height differ by less, any of an octagon's eight sides can be the top."""


def _build_template() -> Tensor:
    rows = []
    for corners_box in _BOX_CORNERS.values():
        padded = corners_box + corners_box[-1:] * (MAX_CORNERS - len(corners_box))
        centred = torch.tensor(padded, dtype=torch.float64)
        rows.append(centred - centred[: len(corners_box)].mean(0))
    return torch.stack(rows)


_TEMPLATE = _build_template()


class TemplateFit(NamedTuple):
    """How a shape lies in corners of a plane: corner k of the shape is corner `(k + shift) % C`."""

    angle: Float[Tensor, " n"]
    """From the plane's x axis to the sign's, anticlockwise [rad]."""
    size: Float[Tensor, "n 2"]
    shift: Int[Tensor, " n"]
    rms: Float[Tensor, " n"]
    """Root mean square distance between fitted and given corners."""


def corner_count(shape: Int[Tensor, "*batch"]) -> Int[Tensor, "*batch"]:
    """How many corners shapes have."""
    return CORNER_COUNT.to(shape.device)[shape]


def is_box(corners_px: Float[Tensor, "m 8 2"], shape: Int[Tensor, " m"]) -> Bool[Tensor, " m"]:
    """Whether outlines are axis-aligned boxes of the image with the shape drawn into them.

    What is upright or level in the shape is so to the last digit, and the rest as exactly as float32 has it. Slots past a
    shape's number of corners repeat one of them.
    """
    low, high = corners_px.amin(1), corners_px.amax(1)
    off = corners_px[:, :, None] - in_box(low, high, shape)[:, None]
    is_near = (off.abs().amax(-1).amin(-1) <= _DRAWN_PX).all(-1)
    return is_near & (_levels(corners_px) <= _levels(template(shape))).all(-1)


def _levels(corners: Float[Tensor, "m 8 2"]) -> Int[Tensor, "m 2"]:
    """How many different places corners have across and up."""
    return 1 + corners.sort(dim=1).values.diff(dim=1).count_nonzero(dim=1)


def in_box(
    low: Float[Tensor, "*batch 2"], high: Float[Tensor, "*batch 2"], shape: Int[Tensor, "*batch"]
) -> Float[Tensor, "*batch 8 2"]:
    """Corners of upright signs that face the camera and fill boxes of the image, v down."""
    drawn = template(shape).to(low)
    least, most = drawn.amin(-2, keepdim=True), drawn.amax(-2, keepdim=True)
    share = (drawn - least) / (most - least)
    # The template's y axis points up.
    share = torch.stack((share[..., 0], 1 - share[..., 1]), dim=-1)
    return low[..., None, :] + share * (high - low)[..., None, :]


def corner_mask(shape: Int[Tensor, "*batch"]) -> Bool[Tensor, "*batch 8"]:
    """True for the slots that hold a corner of the shape."""
    slot = torch.arange(MAX_CORNERS, device=shape.device)
    return slot < corner_count(shape)[..., None]


def template(shape: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch 8 2"]:
    """Corners of shapes of width and height 1 in the sign's plane."""
    return _TEMPLATE.to(shape.device)[shape]


def corners(
    shape: Int[Tensor, "*batch"], size: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch 8 3"]:
    """Corners [m] of shapes of given width and height in the sign's frame; z is 0."""
    xy = template(shape).to(size) * size[..., None, :]
    return torch.cat((xy, torch.zeros_like(xy[..., :1])), dim=-1)


def pad(
    corners: Float[Tensor, "*batch 8 k"], count: Int[Tensor, "*batch"]
) -> Float[Tensor, "*batch 8 k"]:
    """The same corners with the slots past `count` set to the last corner."""
    slot = torch.arange(MAX_CORNERS, device=count.device)
    return _take(corners, torch.minimum(slot, count[..., None] - 1))


def roll(
    corners: Float[Tensor, "*batch 8 k"], shift: Int[Tensor, "*batch"], count: Int[Tensor, "*batch"]
) -> Float[Tensor, "*batch 8 k"]:
    """Corners in another cyclic order: corner k of the result is corner `(k + shift) % count`."""
    slot = torch.arange(MAX_CORNERS, device=count.device)
    slot = torch.minimum(slot, count[..., None] - 1)
    return _take(corners, (slot + shift[..., None]) % count[..., None])


def signed_area(
    corners: Float[Tensor, "*batch 8 2"], mask: Bool[Tensor, "*batch 8"]
) -> Float[Tensor, "*batch"]:
    """Area of polygons, positive if clockwise in an image (v down), negative where y is up."""
    centred = corners - corners[..., :1, :]
    following = _following(centred, mask)
    cross = centred[..., 0] * following[..., 1] - centred[..., 1] * following[..., 0]
    return torch.where(mask, cross, 0.0).sum(-1) / 2


def is_simple(
    corners: Float[Tensor, "*batch 8 2"], mask: Bool[Tensor, "*batch 8"]
) -> Bool[Tensor, "*batch"]:
    """Whether no side has length zero and no two sides that are not neighbours meet."""
    start, end = corners, _following(corners, mask)
    edge = torch.arange(MAX_CORNERS, device=corners.device)
    count = mask.sum(-1)[..., None, None]
    gap = (edge[:, None] - edge) % count
    apart = (gap > 1) & (gap < count - 1) & mask[..., :, None] & mask[..., None, :]

    a, b = start[..., :, None, :], end[..., :, None, :]
    c, d = start[..., None, :, :], end[..., None, :, :]
    # Two segments meet if each one's ends are not strictly on one side of the other, and their
    # boxes overlap (which decides where all four ends are on one line).
    straddle = (_side(a, b, c) * _side(a, b, d) <= 0) & (_side(c, d, a) * _side(c, d, b) <= 0)
    low_ab, high_ab = torch.minimum(a, b), torch.maximum(a, b)
    low_cd, high_cd = torch.minimum(c, d), torch.maximum(c, d)
    overlap = ((low_ab <= high_cd) & (low_cd <= high_ab)).all(-1)
    crossing = (apart & straddle & overlap).any(-1).any(-1)
    collapsed = (mask & (start == end).all(-1)).any(-1)
    return ~crossing & ~collapsed


def best_shift(
    a: Float[Tensor, "*batch 8 k"], b: Float[Tensor, "*batch 8 k"], count: Int[Tensor, "*batch"]
) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """The cyclic shift s with the least cost, and that cost.

    The cost is the sum over k of `|a_k - b_((k + s) % count)|^2`.
    Both lists run the same way round, so of all assignments of corners (IV-A) only the cyclic ones
    preserve the outline.
    """
    mask = torch.arange(MAX_CORNERS, device=count.device) < count[..., None]
    costs = []
    for s in range(MAX_CORNERS):
        error = (a - roll(b, torch.full_like(count, s), count)).square().sum(-1)
        cost = torch.where(mask, error, 0.0).sum(-1)
        costs.append(torch.where(s < count, cost, math.inf))
    cost, shift = torch.stack(costs, dim=-1).min(-1)
    return shift, cost


def canonical(
    T_world_sign: Float[Tensor, "*batch 4 4"],
    size: Float[Tensor, "*batch 2"],
    shape: Int[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch 4 4"], Float[Tensor, "*batch 2"]]:
    """The same signs with the up axis that is nearest to world up (FORMAT.md: a map's corners)."""
    T, size, _ = canonical_with_shift(T_world_sign, size, shape)
    return T, size


def canonical_with_shift(
    T_world_sign: Float[Tensor, "*batch 4 4"],
    size: Float[Tensor, "*batch 2"],
    shape: Int[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch 4 4"], Float[Tensor, "*batch 2"], Int[Tensor, "*batch"]]:
    """As `canonical`; corner k of the result is corner `(k + shift) % C` of the sign given.

    Rectangles, diamonds and octagons look the same in steps of a quarter turn with width and height
    exchanged, octagons that are regular within 2 % also in steps of an eighth, their width and
    height then becoming equal. The other shapes have one up axis only. A tie (a square standing on
    its corner) goes to the right axis that points up, then to north.
    """
    eighth = torch.arange(8, device=size.device)
    angle = eighth.to(size) * (math.pi / 4)
    x, y = T_world_sign[..., None, :3, 0], T_world_sign[..., None, :3, 1]
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    score = _upright(x * cos + y * sin, y * cos - x * sin)

    symmetric = (shape == RECTANGLE) | (shape == DIAMOND) | (shape == OCTAGON)
    difference = (size[..., 0] - size[..., 1]).abs()
    regular = (shape == OCTAGON) & (difference < _REGULAR_TOLERANCE * size.amax(-1))
    allowed = (eighth == 0) | (symmetric[..., None] & (eighth % 2 == 0)) | regular[..., None]
    turn = torch.where(allowed, score, -math.inf).argmax(-1)

    size = torch.where((turn % 4 == 2)[..., None], size.flip(-1), size)
    size = torch.where((turn % 2 == 1)[..., None], size.mean(-1, keepdim=True), size)
    w = torch.zeros_like(T_world_sign[..., :3, 3])
    w = torch.stack((w[..., 0], w[..., 1], angle[turn]), dim=-1)
    T = se3.retract(T_world_sign, torch.cat((torch.zeros_like(w), w), dim=-1))
    # Turning anticlockwise by one corner makes the corner before the first the first.
    count = corner_count(shape)
    corners_per_turn = torch.where(symmetric, count, 0)
    return T, size, (-turn * corners_per_turn // 8) % count


def fit_template(
    corners_plane: Float[Tensor, "n 8 2"], shape: Int[Tensor, " n"], *, shifts: int = MAX_CORNERS
) -> TemplateFit:
    """Rotation, size and cyclic shift, of the first `shifts`, with which shapes match corners best, upright ones preferred.

    Corners are centred on their mean, run clockwise in a plane with y up, and start anywhere. Each
    shift has its own least-squares rotation and size in closed form. Which shift is right shows in
    the misfit for a pentagon only; a rectangle fits in any, an equilateral triangle too. So the
    score is the misfit over the size plus half of 1 - cos of the angle from upright.
    """
    count = corner_count(shape)
    mask = corner_mask(shape)[..., None]
    tau = torch.where(mask, template(shape).to(corners_plane), 0.0)
    # The corners of all shapes have no correlation between x and y, so the best linear map is found
    # column by column.
    moment = tau.square().sum(1)
    angles, sizes, errors, scores = [], [], [], []
    for s in range(shifts):
        rolled = roll(corners_plane, torch.full_like(count, s), count)
        A = (rolled.mT @ tau) / moment[:, None, :]
        # R(angle) diag(w, h) nearest to A: the angle maximises a quadratic form in (cos, sin).
        first, second = A[..., 0], torch.stack((A[:, 1, 1], -A[:, 0, 1]), dim=-1)
        m, k = moment.unbind(-1)
        c2 = m * (first[:, 0] ** 2 - first[:, 1] ** 2) + k * (second[:, 0] ** 2 - second[:, 1] ** 2)
        s2 = 2 * (m * first[:, 0] * first[:, 1] + k * second[:, 0] * second[:, 1])
        half = torch.atan2(s2, c2) / 2
        axis = torch.stack((half.cos(), half.sin()), dim=-1)
        flip = ((first + second) * axis).sum(-1) < 0
        axis = torch.where(flip[:, None], -axis, axis)
        size = torch.stack(((first * axis).sum(-1), (second * axis).sum(-1)), dim=-1)
        across = torch.stack((-axis[:, 1], axis[:, 0]), dim=-1)
        scaled = tau * size[:, None, :]
        fitted = scaled[..., :1] * axis[:, None, :] + scaled[..., 1:] * across[:, None, :]
        misfit = torch.where(mask, (fitted - rolled).square(), 0.0).sum((1, 2))
        rms = (misfit / count).sqrt()
        scale = corners_plane.square().sum(-1).amax(-1).sqrt().clamp_min(1e-12)
        # The sine decides ties as `canonical` does: the right axis points up.
        score = rms / scale + 0.5 * (1 - axis[:, 0]) - _TIE * axis[:, 1]
        valid = (s < count) & (size > 0).all(-1)
        angles.append(torch.atan2(axis[:, 1], axis[:, 0]))
        sizes.append(size)
        errors.append(rms)
        scores.append(score + torch.where(valid, 0.0, torch.where(s < count, 1e6, math.inf)))
    shift = torch.stack(scores, dim=-1).argmin(-1)
    row = torch.arange(len(shape), device=shape.device)
    angle, size, rms = (torch.stack(part, dim=1)[row, shift] for part in (angles, sizes, errors))
    return TemplateFit(angle, size.clamp_min(1e-6), shift, rms)


def fit_sign(
    corners_world: Float[Tensor, "n 8 3"],
    shape: Int[Tensor, " n"],
    toward_world: Float[Tensor, "n 3"],
    *,
    shifts: int = MAX_CORNERS,
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n 2"], Int[Tensor, " n"]]:
    """T_world_sign, size [m] and cyclic shift of signs from corners almost in a plane (IV-B).

    Corners run clockwise as seen from the viewer and start anywhere; corner k of the sign is corner
    `(k + shift) % C`, with a shift below `shifts`. The normal is on the side of `toward_world`, a direction to the viewer.
    """
    weight = corner_mask(shape).to(corners_world)
    centre, normal, _ = plane.fit_plane(corners_world, weight)
    facing = (normal * toward_world).sum(-1, keepdim=True)
    z = torch.where(facing < 0, -normal, normal)
    # The plane's own up: world up, or north where the sign lies flat.
    world_up = z.new_tensor((0.0, 0.0, 1.0)).expand_as(z)
    north = z.new_tensor((0.0, 1.0, 0.0)).expand_as(z)
    level = z[:, 2:].abs() > 1 - 1e-9
    up = torch.where(level, north, world_up)
    y = torch.nn.functional.normalize(up - (up * z).sum(-1, keepdim=True) * z, dim=-1)
    T_world_plane = se3.make(torch.stack((torch.linalg.cross(y, z), y, z), dim=-1), centre)
    corners_plane = se3.transform(se3.inverse(T_world_plane)[:, None], corners_world)[..., :2]
    fit = fit_template(corners_plane, shape, shifts=shifts)
    zero = torch.zeros_like(fit.angle)
    turn = torch.stack((zero, zero, zero, zero, zero, fit.angle), dim=-1)
    return se3.retract(T_world_plane, turn), fit.size, fit.shift


_TIE = 1e-6
"""How much the second criterion counts where the first one ties up to rounding."""


def _upright(x: Tensor, y: Tensor) -> Tensor:
    """How upright axes x (right) and y (up) are; small terms settle ties always the same way."""
    tie = x[..., 2] + 0.1 * y[..., 1] + 0.01 * x[..., 1]
    return y[..., 2] + _TIE * tie


def _take(corners: Tensor, slot: Tensor) -> Tensor:
    slot = slot.expand(corners.shape[:-1])[..., None].expand(corners.shape)
    return corners.gather(-2, slot)


def _following(corners: Tensor, mask: Tensor) -> Tensor:
    slot = torch.arange(MAX_CORNERS, device=corners.device)
    count = mask.sum(-1)[..., None]
    return _take(corners, torch.where(slot + 1 < count, (slot + 1) % MAX_CORNERS, 0))


def _side(a: Tensor, b: Tensor, p: Tensor) -> Tensor:
    """Sign of the side of the line from a to b that p is on (products of areas would underflow)."""
    ab, ap = b - a, p - a
    return (ab[..., 0] * ap[..., 1] - ab[..., 1] * ap[..., 0]).sign()
