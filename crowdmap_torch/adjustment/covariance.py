"""How sure an adjusted map is: covariances of signs, their corners, lanes and journeys' errors, from one factorisation.

The covariance of the landmarks is the inverse of the reduced system that bundle adjustment solves, poses and biases
marginalised, as far as landmarks are bound to each other; what all positions share is kept apart.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.bias_sums import bias_of_poses, sums_of_bias
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.convoys import Convoys
from crowdmap_torch.adjustment.found_calibration import (
    FleetCalibration,
    found_calibration,
    sigma_of_mean,
)
from crowdmap_torch.adjustment.influence import Influence, influence
from crowdmap_torch.fleet.engine import Engine
from crowdmap_torch.geometry import polygon, se3, spline_basis
from crowdmap_torch.geometry.covariances import at_least
from crowdmap_torch.optim.problem import Values
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions, MapCovariance
from crowdmap_torch.processes.memory import give_back
from crowdmap_torch.tables import Lanes, Signs

_MOST_PLACES = 200
"""Signs, or places along the lanes of a map without any, of which it is asked what all have in common: their covariance is
dense."""


@dataclass(frozen=True)
class MapUncertainty:
    """Covariances of an adjusted map, absolute: what all positions share included."""

    center: Float[Tensor, "n 3 3"]
    """Of the signs' centres [m^2]."""
    corner: Float[Tensor, "n 8 3 3"]
    """Of the signs' corners, in the order of FORMAT.md [m^2]."""
    lane_sigma: Float[Tensor, " c"]
    """1-sigma of the lateral position at the lanes' control points [m]."""
    shared: Float[Tensor, "3 3"]
    """What all positions have in common: the largest covariance that can be taken off all of them together so that
    what is left is a covariance [m^2]."""
    bias: Float[Tensor, "j 4"]
    """By journey the mean error of its poses along the way, the adjusted minus the given ones: east, north, up [m] and
    heading [rad], counted from east to north. NaN for journeys that had no say."""
    bias_covariance: Float[Tensor, "j 4 4"]
    calibration: FleetCalibration
    """What cars have wrong for good; empty where that is not asked."""
    calibration_mean_sigma: dict[str, tuple[float, ...]]
    """1-sigma of its mean over all cars, by parameter."""
    influence: Influence | None = None
    """What the map would be without each of the drives; None: that is not asked."""

    @property
    def of_their_own(self) -> Float[Tensor, "n 3 3"]:
        """Covariance of the signs' centres without what all positions share [m^2].

        That is found of some places: along axes where a sign is surer than that, nothing is left.
        """
        return at_least(self.center - self.shared, 0.0)

    def of_signs(self, into: Int[Tensor, " n"]) -> MapUncertainty:
        """The same but for the signs that go `into` another one, or none, -1; what stays is its own."""
        own = into == torch.arange(len(into), device=into.device)
        found = self.influence
        if found is not None and len(into):
            far, number = found.farthest_sign, own.cumsum(0) - 1
            far = torch.where(far < 0, far, into[far.clamp_min(0)])
            renumbered = torch.where(far < 0, far, number[far.clamp_min(0)])
            found = replace(found, farthest_sign=renumbered)
        return replace(self, center=self.center[own], corner=self.corner[own], influence=found)


@torch.no_grad()
def map_uncertainty(
    bundle: Bundle, signs: Signs, lanes: Lanes, engine: Engine | None = None
) -> MapUncertainty:
    """Covariances at the bundle's values; `signs` and `lanes` are those that it was built from.

    Of many drives they are found by the hosts of an engine, as steps are; None: all in this process.
    """
    values = bundle.values()
    nodes = bundle.prior.nodes
    journeys = len(values["bias"])
    expected = bundle.prior.expected_scale(values["drift"], bundle.prior_scale, bundle.drift_told)
    with ExitStack() as ends:
        if len(bundle.convoys) > 1:
            convoys = ends.enter_context(Convoys(bundle, None, engine))
            covariance, of_bias = convoys.covariance(expected)
        else:
            equations = bundle.backend().assemble(bundle.information(expected), values)
            # What was added up leaves room where the factor goes.
            give_back()
            covariance = equations.covariance()
            of_bias = covariance.of_sums(*sums_of_bias(bundle))
    if len(bundle.convoys) > 1:
        # The convoys are gone, and with them who else had the factors.
        covariance = covariance.resting()
        give_back()
    to_bias = bias_of_poses(values["pose"][nodes.first])
    count = torch.bincount(nodes.journey, minlength=journeys)
    every = torch.arange(len(signs), device=count.device)
    sign = LinearFunctions.of_tangents((("sign", every), ("size", every)), to_bias, 6, 2)
    of_sign = covariance.of(sign)
    shared = _shared(covariance, values, to_bias)
    bias = (to_bias @ values["drift"][:, :6, None])[..., 0]
    bias = nodes.mean(bias, journeys)
    silent = count == 0
    center = of_sign[:, :3, :3]
    return MapUncertainty(
        center=center,
        corner=_corner_covariance(values["sign"], values["size"], signs, of_sign),
        lane_sigma=_lane_sigma(bundle, lanes, covariance),
        shared=(shared + shared.mT) / 2,
        bias=bias.masked_fill(silent[:, None], torch.nan),
        bias_covariance=of_bias.masked_fill(silent[:, None, None], torch.nan),
        calibration=found_calibration(bundle, covariance),
        calibration_mean_sigma=sigma_of_mean(bundle, covariance),
        influence=influence(bundle, center, engine) if bundle.config.influence else None,
    )


def _shared(covariance: MapCovariance, values: Values, like: Tensor) -> Float[Tensor, "3 3"]:
    """What the positions of signs have in common; of a map without signs, those along its lanes.

    Of many those that are surest, and others spread over the map: what single places have to themselves is a 200th of it.
    """
    for name, dim in (("sign", 6), ("lane", 3)):
        every = torch.arange(len(values[name]), device=like.device)
        if not len(every):
            continue
        position = torch.eye(3, dim).to(like)
        if len(every) > _MOST_PLACES:
            own = covariance.of(_places(name, every, position)).diagonal(dim1=-2, dim2=-1).sum(-1)
            surest = torch.argsort(own, stable=True)[: _MOST_PLACES // 2]
            spread = every[:: -(-len(every) // (_MOST_PLACES // 2))]
            every = torch.unique(torch.cat((surest, spread)))
        return covariance.common(_places(name, every, position))
    return like.new_zeros(3, 3)


def _places(name: str, block: Int[Tensor, " n"], position: Float[Tensor, "3 k"]) -> LinearFunctions:
    """Where blocks of a variable are, as functions of its tangents."""
    return LinearFunctions(((name, block),), (position.expand(len(block), *position.shape),))


def _corner_covariance(
    T_world_sign: Float[Tensor, "n 4 4"],
    size: Float[Tensor, "n 2"],
    signs: Signs,
    joint: Float[Tensor, "n 8 8"],
) -> Float[Tensor, "n 8 3 3"]:
    """Covariance of each corner from that of the sign's pose and size, corners in the order of FORMAT.md."""
    T, canonical_size = polygon.canonical(T_world_sign, size, signs.shape)
    corner_world = se3.transform(T[:, None], polygon.corners(signs.shape, canonical_size))
    corner = se3.transform(se3.inverse(T_world_sign)[:, None], corner_world)
    R = T_world_sign[:, None, :3, :3].expand(-1, corner.shape[1], 3, 3)
    # By translation, by turning about the sign's axes (w x c), and by the relative change of its sides.
    by_turn = -R @ se3.skew(corner)
    by_size = R[..., :2] * corner[..., None, :2]
    J = torch.cat((torch.eye(3).to(R).expand_as(R), by_turn, by_size), dim=-1)
    return J @ joint[:, None] @ J.mT


def _lane_sigma(bundle: Bundle, lanes: Lanes, covariance: MapCovariance) -> Float[Tensor, " c"]:
    """1-sigma of every control point across its lane; a control point is a weighted sum of coefficients."""
    if not len(lanes):
        return bundle.lane_points.camera_height.new_zeros(0)
    count = lanes.control_count
    spline, rank = spline_basis.rows(count)
    start = spline_basis.starts(count)
    across = bundle.lane_axes[:, :, 1]
    row, weight, _ = spline_basis.window_flat(rank.to(across), start[spline], count[spline])
    by_coefficient = weight[:, :, None] * across[:, None]
    point = LinearFunctions(
        tuple(("lane", of) for of in row.unbind(1)), by_coefficient[:, None].unbind(2)
    )
    return covariance.of(point)[:, 0, 0].clamp_min(0).sqrt()
