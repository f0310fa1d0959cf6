"""What observations say of the unknowns, taken anew where these are by now: lenses, and what cars have wrong of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.calibration import ByOptics, Fleet
from crowdmap_torch.adjustment.lane_matching import LaneMatches
from crowdmap_torch.adjustment.lenses import relinearised, rows_by_lens
from crowdmap_torch.adjustment.observations import CornerObservations, LanePointObservations
from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.processes.threads import in_order

_AT_ONCE = 1 << 14
"""Rows that are seen to at once on a CPU."""


@dataclass(frozen=True)
class Linearised:
    """Observations with every lens as it is where their points were last, and their derivatives by their cars' optics."""

    corners: CornerObservations
    by_corner: ByOptics
    lane_points: LanePointObservations
    by_lane_point: ByOptics


def relinearise(
    observed: Linearised,
    values: Mapping[str, Tensor],
    matches: LaneMatches,
    lane_count: Int[Tensor, " n"],
    lenses: Sequence[Camera],
    fleet: Fleet,
    left_lane: Float[Tensor, "c 3"],
) -> None:
    """Takes them anew with the unknowns, and the splines' matches, where they are: in place, a second set would be large.

    `left_lane` is across each lane coefficient's marker, along the road.
    """
    T_camera_world = se3.inverse(values["pose"])
    of_coefficients = torch.cat((values["lane"], left_lane), dim=1)

    def corners(at: slice) -> tuple[Tensor, ByOptics]:
        rows = observed.corners[at]
        corner = torch.nn.functional.pad(rows.template * values["size"][rows.sign], (0, 1))
        point = se3.transform(values["sign"][rows.sign], corner)
        return seen(rows, point, None)

    def lane_points(at: slice) -> tuple[Tensor, ByOptics]:
        point, across = matches[at].points(of_coefficients, lane_count).split(3, dim=1)
        return seen(observed.lane_points[at], point, across)

    def seen(
        rows: CornerObservations | LanePointObservations,
        point_world: Float[Tensor, "m 3"],
        across: Float[Tensor, "m 3"] | None,
    ) -> tuple[Tensor, ByOptics]:
        point = se3.transform(T_camera_world[rows.frame], point_world)
        rows = relinearised(rows, lenses, rows_by_lens(rows, lenses), point)
        return rows.matrix, fleet.by_optics(rows, lenses, point, values["pose"], across)

    # At once they would take as much memory as all normal equations.
    of_corners = corners, observed.corners.matrix, observed.by_corner
    of_points = lane_points, observed.lane_points.matrix, observed.by_lane_point
    pieces = [(at, *of_corners) for at in _pieces(observed.corners.detection)]
    pieces += [(at, *of_points) for at in _pieces(observed.lane_points.frame)]
    found = in_order(lambda piece: piece[1](piece[0]), pieces, values["pose"].device, worth=1)
    for (at, _, matrix, by_optics), (own, derivatives) in zip(pieces, found, strict=True):
        matrix[at] = own
        by_optics.put(at, derivatives)


def _pieces(label: Int[Tensor, " m"]) -> list[slice]:
    """Some rows after the other, those of a label, which are adjacent, in one piece."""
    lot = at_once(_AT_ONCE, label.device)
    if len(label) <= lot:
        return [slice(0, len(label))] if len(label) else []
    begins = torch.nonzero(label[1:] != label[:-1])[:, 0] + 1
    wanted = torch.arange(lot, len(label), lot, device=label.device)
    at = torch.searchsorted(begins, wanted)
    cuts = begins[at[at < len(begins)]].unique().tolist()
    return [slice(a, b) for a, b in zip([0, *cuts], [*cuts, len(label)], strict=True)]
