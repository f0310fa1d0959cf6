"""Terms of lane points: their distance from the projected spline across it, and the spline's height over the road (V-B)."""

from __future__ import annotations

from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.adjustment.lane_matching import LaneMatches
from crowdmap_torch.adjustment.observations import LanePointObservations
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.residuals import lane


def lane_point_terms(
    rows: LanePointObservations,
    matches: LaneMatches,
    lane_count: Int[Tensor, " n"],
    sigma: float,
    tukey_c: float,
) -> dict[str, CostTerm]:
    """The terms of points of which each is held against the four coefficients about its match.

    `lane_count` has the coefficients of every lane; `sigma` is that of a point across its marker [px].
    """
    coefficient, weight = matches.windows(lane_count)
    beside = (("lane", column.contiguous()) for column in coefficient.unbind(1))
    slots, valid = (("pose", rows.frame), *beside), matches.valid.to(weight)
    image = CostTerm(
        lane.lane_reprojection,
        slots,
        (weight, matches.normal_px, rows.matrix),
        valid / sigma,
        Tukey(tukey_c),
        lane.lane_reprojection_jacobian,
    )
    height = CostTerm(
        lane.lane_height,
        slots,
        (weight, rows.normal_camera, rows.camera_height),
        valid / rows.height_sigma,
        Tukey(tukey_c),
        lane.lane_height_jacobian,
    )
    return {"lane_reprojection": image, "lane_height": height}
