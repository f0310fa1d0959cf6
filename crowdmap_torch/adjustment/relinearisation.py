"""What observations say of the unknowns, taken anew where these are by now: lenses, and what cars have wrong of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.calibration import ByOptics, Fleet
from crowdmap_torch.adjustment.lane_matching import LaneMatches
from crowdmap_torch.adjustment.lenses import relinearised, rows_by_lens
from crowdmap_torch.adjustment.observations import CornerObservations, LanePointObservations
from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.processes.threads import in_order

_AT_ONCE = 1 << 14
"""Rows that are seen to at once."""
Observed = TypeVar("Observed", CornerObservations, LanePointObservations)


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
    fleet: Fleet,
    left_lane: Float[Tensor, "c 3"],
) -> Relinearised:
    """Those with the unknowns, and the splines' matches, where they are.

    `left_lane` is across each lane coefficient's marker, along the road. Without a point of a kind its derivatives stay.
    """
    T_camera_world = se3.inverse(values["pose"])
    of_coefficients = torch.cat((values["lane"], left_lane), dim=1)

    def corners(at: slice) -> tuple[Tensor, ByOptics]:
        rows = before.corners[at]
        corner = torch.nn.functional.pad(rows.template * values["size"][rows.sign], (0, 1))
        point = se3.transform(values["sign"][rows.sign], corner)
        return seen(rows, point, None)

    def lane_points(at: slice) -> tuple[Tensor, ByOptics]:
        point, across = matches[at].points(of_coefficients, lane_count).split(3, dim=1)
        return seen(before.lane_points[at], point, across)

    def seen(
        rows: CornerObservations | LanePointObservations,
        point_world: Float[Tensor, "m 3"],
        across: Float[Tensor, "m 3"] | None,
    ) -> tuple[Tensor, ByOptics]:
        point = se3.transform(T_camera_world[rows.frame], point_world)
        rows = relinearised(rows, lenses, rows_by_lens(rows, lenses), point)
        return rows.matrix, fleet.by_optics(rows, lenses, point, values["pose"], across)

    # At once they would take as much memory as all normal equations.
    pieces = [(corners, at) for at in _pieces(before.corners.detection)]
    first_point = len(pieces)
    pieces += [(lane_points, at) for at in _pieces(before.lane_points.frame)]
    device = values["pose"].device
    found = in_order(lambda piece: piece[0](piece[1]), pieces, device, worth=1)
    of_corners, of_points = (
        [at for _, at in some] for some in (pieces[:first_point], pieces[first_point:])
    )
    return Relinearised(
        *_joined(before.corners, before.by_corner, of_corners, found),
        *_joined(before.lane_points, before.by_lane_point, of_points, found),
    )


def _joined(
    rows: Observed, by: ByOptics, pieces: Sequence[slice], found: Iterator[tuple[Tensor, ByOptics]]
) -> tuple[Observed, ByOptics]:
    """The rows with the matrices and derivatives of all pieces, which are found next; as they are without any."""
    if not pieces:
        return rows, by
    # Each goes to its place when it comes: all of them, and then one, would be another copy.
    matrix, together = rows.matrix.new_empty(rows.matrix.shape), by.room()
    for at, (own, derivatives) in zip(pieces, found, strict=False):
        matrix[at] = own
        together.put(at, derivatives)
    return replace(rows, matrix=matrix), together


def _pieces(label: Int[Tensor, " m"]) -> list[slice]:
    """Some rows after the other, those of a label, which are adjacent, in one piece."""
    if len(label) <= _AT_ONCE:
        return [slice(0, len(label))] if len(label) else []
    begins = torch.nonzero(label[1:] != label[:-1])[:, 0] + 1
    wanted = torch.arange(_AT_ONCE, len(label), _AT_ONCE, device=label.device)
    at = torch.searchsorted(begins, wanted)
    cuts = begins[at[at < len(begins)]].unique().tolist()
    return [slice(a, b) for a, b in zip([0, *cuts], [*cuts, len(label)], strict=True)]
