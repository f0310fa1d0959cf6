"""What observations say of the unknowns, taken anew where these are by now: lenses, and what cars have wrong of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.calibration import ByOptics, Fleet
from crowdmap_torch.adjustment.lane_matching import LaneMatches
from crowdmap_torch.adjustment.lenses import relinearised
from crowdmap_torch.adjustment.observations import CornerObservations, LanePointObservations
from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.processes.threads import beside


@dataclass(frozen=True)
class Relinearised:
    """Observations with every lens as it is where their points are, and their derivatives by their cars' optics."""

    corners: CornerObservations
    by_corner: ByOptics
    lane_points: LanePointObservations
    by_lane_point: ByOptics


def relinearised_at(
    values: Mapping[str, Tensor],
    before: Relinearised,
    matches: LaneMatches,
    lane_count: Int[Tensor, " n"],
    lenses: Sequence[Camera],
    by_lens: tuple[Sequence[Int[Tensor, " _"]], Sequence[Int[Tensor, " _"]]],
    fleet: Fleet,
    left_lane: Float[Tensor, "c 3"],
) -> Relinearised:
    """Those with the unknowns, and the splines' matches, where they are; `by_lens` are the `rows_by_lens` of both kinds.

    `left_lane` is across each lane coefficient's marker, along the road. Without a point of a kind its derivatives stay.
    """

    def corners() -> tuple[CornerObservations, ByOptics]:
        rows = before.corners
        if not len(rows):
            return rows, before.by_corner
        sign = values["sign"][rows.sign]
        corner = torch.nn.functional.pad(rows.template * values["size"][rows.sign], (0, 1))
        point = se3.transform(sign, corner)
        seen = se3.transform(se3.inverse(values["pose"])[rows.frame], point)
        rows = relinearised(rows, lenses, by_lens[0], seen)
        return rows, fleet.by_optics(rows, lenses, seen, values["pose"])

    def lane_points() -> tuple[LanePointObservations, ByOptics]:
        rows = before.lane_points
        if not len(rows):
            return rows, before.by_lane_point
        point = matches.points(values["lane"], lane_count)
        seen = se3.transform(se3.inverse(values["pose"])[rows.frame], point)
        rows = relinearised(rows, lenses, by_lens[1], seen)
        across = matches.points(left_lane, lane_count)
        return rows, fleet.by_optics(rows, lenses, seen, values["pose"], across)

    of_corners, of_points = beside(corners, lane_points, device=values["pose"].device)
    return Relinearised(*of_corners, *of_points)
