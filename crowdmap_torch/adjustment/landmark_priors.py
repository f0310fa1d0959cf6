"""What is known of signs and lanes before anything is seen of them: their terms of the bundle (V-B)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.observations import CornerObservations
from crowdmap_torch.adjustment.parts import Observations
from crowdmap_torch.geometry import polygon, spline_basis
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.residuals.lane import lane_prior, lane_stretch
from crowdmap_torch.residuals.sign_prior import against_the_drive, habit_term, sign_place
from crowdmap_torch.survey.control import ControlSigns
from crowdmap_torch.tables import Lanes, Signs


def fixed_terms(
    values: dict[str, Tensor],
    signs: Signs,
    lanes: Lanes,
    up: Float[Tensor, "c 3"],
    corners: CornerObservations,
    control: ControlSigns | None,
    config: AdjustConfig,
) -> dict[str, CostTerm]:
    """What is known of signs and lanes before anything is seen of them."""
    fixed = _lane_prior(values["lane"], lanes, up, config)
    if len(corners):
        facing = against_the_drive(values["pose"][corners.frame], corners.sign, len(signs))
        # Signs that nobody sees stay as they are.
        own = corners.sign.unique()
        fixed["sign_habit"] = habit_term(facing[own], own, config.habit)
    if control is not None and len(control):
        fixed["control"] = _control_term(control, signs)
    return fixed


def _control_term(control: ControlSigns, signs: Signs) -> CostTerm:
    """Surveyed centres of signs; a sign's centre is the mean of its corners."""
    shape = signs.shape[control.sign]
    mask = polygon.corner_mask(shape)[..., None].to(control.center_world)
    template = (polygon.template(shape).to(mask) * mask).sum(1) / mask.sum(1)
    return CostTerm(
        sign_place,
        (("sign", control.sign), ("size", control.sign)),
        (template, control.center_world),
        1 / control.sigma,
        takes_rows=True,
    )


def up_of_road(
    observed: Observations,
    T_world_camera: Float[Tensor, "p 4 4"],
    coefficient: Float[Tensor, "c 3"],
    count: Int[Tensor, " n"],
) -> Float[Tensor, "c 3"]:
    """Up from the road at each lane coefficient, in the mean of all who saw it; upwards where nobody did."""
    points = observed.lane_points
    of_frame = T_world_camera[points.frame, :3, :3]
    normal = -(of_frame @ points.normal_camera[..., None])[..., 0]
    beside, weight = observed.matches.windows(count)
    up = torch.zeros_like(coefficient)
    up[:, 2] = 1e-6
    for row, share in zip(beside.unbind(1), weight.unbind(1), strict=True):
        up.index_add_(0, row, share.abs()[:, None] * normal)
    return torch.nn.functional.normalize(up, dim=-1)


def _lane_prior(
    coefficient: Float[Tensor, "c 3"], lanes: Lanes, up: Float[Tensor, "c 3"], config: AdjustConfig
) -> dict[str, CostTerm]:
    """What holds control points together where observations do not; `up` is away from the road at each.

    Not where they started: that would count the journeys' own positions twice.
    """
    if not len(lanes):
        return {}
    spline, rank = spline_basis.rows(lanes.control_count)
    along = spline_basis.derivative_flat(
        lanes.control.point_world, lanes.control_count, rank.to(coefficient), spline
    )
    forward = torch.nn.functional.normalize(along, dim=-1)
    left = torch.nn.functional.normalize(torch.linalg.cross(up, forward), dim=-1)
    axes = torch.stack((forward, left, torch.linalg.cross(forward, left)), dim=-1)
    place = CostTerm(
        lane_prior,
        (("lane", torch.arange(len(coefficient), device=coefficient.device)),),
        (coefficient.clone(), axes),
        coefficient.new_full((len(coefficient),), 1 / config.lane_place_sigma_m),
        takes_rows=True,
    )
    first = torch.nonzero(spline[1:] == spline[:-1])[:, 0]
    step = CostTerm(
        lane_stretch,
        (("lane", first), ("lane", first + 1)),
        (coefficient[first + 1] - coefficient[first], axes[first]),
        (1 / coefficient.new_tensor(config.lane_step_sigma_m)).expand(len(first), 3).contiguous(),
        takes_rows=True,
    )
    return {"lane_prior": place, "lane_stretch": step}
