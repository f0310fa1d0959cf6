"""How noisy the corners of a drive are, told by themselves (IV-B): by how outlines change from view to view.

Where a sign is seen from moves its outline and makes it larger, little by little; what else changes between two views of one
track in a row is noise of its corners, on a post or on a bus. So this needs no fit, and nothing that misfits spoils it, but
it does not see what all corners of a detection have wrong together.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import polygon
from crowdmap_torch.noise.pixels import PixelNoiseConfig, corner_variance, longer_side
from crowdmap_torch.optim.robust import usual
from crowdmap_torch.signs.views import SignViews, sign_by_sign

_AS_ASSUMED = 8.0
"""Pairs of views with the noise that is assumed that count beside those of a drive."""
_OF_MOVES = 3
"""Numbers of an outline that moves and scale take: they tell of no noise."""


def corner_noise(views: SignViews, shape: Int[Tensor, " n"], config: PixelNoiseConfig) -> float:
    """Noise of the drive's corners as a multiple of what is assumed, at least 1: the median of pairs of views in a row."""
    order = sign_by_sign(views)
    first, second = order[:-1], order[1:]
    is_pair = views.sign[first] == views.sign[second]
    first, second = first[is_pair], second[is_pair]
    own = shape[views.sign[first]]
    outline = views.corners_px[torch.stack((first, second))]
    corner = polygon.corner_mask(own)[..., None].to(outline)
    number = corner.sum(-2, keepdim=True)
    outline = (outline - (outline * corner).sum(-2, keepdim=True) / number) * corner
    extent = outline.square().sum((-2, -1), keepdim=True).sqrt().clamp_min(1e-9)
    # Both as large as the geometric mean of the two.
    change = (outline[0] / extent[0] - outline[1] / extent[1]) * (extent[0] * extent[1]).sqrt()
    is_box = polygon.is_box(views.corners_px, shape[views.sign])
    is_box = is_box[first] & is_box[second]
    freedom = torch.where(is_box, 1.0, 2 * number[:, 0, 0] - _OF_MOVES)
    variance = torch.where(is_box, _of_sides(own), freedom)
    # The median of a chi-squared (Wilson and Hilferty 1931), of two views.
    expected = 2 * variance * (1 - 2 / (9 * freedom)) ** 3
    box = longer_side(views.corners_px)
    assumed = corner_variance((box[first] * box[second]).sqrt().clamp_min(1.0), config)
    ratio = change.square().sum((-2, -1)) / (expected * assumed)
    return max(usual(ratio, torch.ones_like(ratio), assumed=1.0, beside=_AS_ASSUMED) ** 0.5, 1.0)


def _of_sides(shape: Int[Tensor, " p"]) -> Float[Tensor, " p"]:
    """Mean squared change of the one form that square boxes have, of all corners together, in units of a side's variance.

    Of a shape in a box of size one whose squared corners add up to A across and B up it is A B (dw - dh)^2 / (A + B), and
    width and height are those of two sides each.
    """
    drawn = polygon.template(shape) * polygon.corner_mask(shape)[..., None]
    across, up = drawn.square().sum(1).unbind(-1)
    return 4 * across * up / (across + up)
