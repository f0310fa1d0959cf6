"""What a bundle has: the unknowns of bundle adjustment, the observations of them, and the scales that weigh these (V-B)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from crowdmap_torch.adjustment.calibration import ByOptics, Fleet
from crowdmap_torch.adjustment.calibration_priors import CalibrationScales
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.cuts import convoys
from crowdmap_torch.adjustment.lane_matching import LaneMatches
from crowdmap_torch.adjustment.observations import CornerObservations, LanePointObservations
from crowdmap_torch.adjustment.parts import VARIABLES, Observations, Priors, SharedOut, Unknowns
from crowdmap_torch.adjustment.relinearisation import Linearised, relinearise
from crowdmap_torch.adjustment.shared_corner_errors import CornerDetections, KeptDetections
from crowdmap_torch.optim.problem import CostTerm, Variable, euclidean, pull_euclidean
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.journey_system import JourneyBackend
from crowdmap_torch.processes.at_rest import rest
from crowdmap_torch.processes.together import ALONE
from crowdmap_torch.tables import to_device

_SIZE_FELT = 0.01
"""Root of what lasts of detections' sizes, below which a change of it is no change of scales."""


class BundleState(nn.Module):
    """The unknowns of bundle adjustment and all observations of them.

    Every unknown is a base value on its manifold (a buffer) and a tangent increment (an `nn.Parameter`) that is zero at
    rest: `state_dict()` is all that changes, and a bundle that loads it goes on as if it had never stopped; an optimiser
    that steps the increments stays on the manifold.
    """

    match_t: Tensor
    match_normal: Tensor
    match_valid: Tensor
    refreshed: Tensor
    """Whether matches and scales have been found."""
    scale: Tensor
    """Standard deviation of sign corners of large boxes, and of lane points [px], as the residuals show it; factor on
    that of lane points, as those of one detection err together."""
    small_box: Tensor
    """Box [px] at which a corner's standard deviation is 1.41 times that of a large box."""
    lasting: Tensor
    """Variance [px^2] of a detection's shift, in the mean of many successive ones, beyond its corners' noise; likewise of
    the share by which a detection is too large."""
    lasting_each: Tensor
    """The same of single ones."""
    judged: Tensor
    """How often detections were judged by everything else, with none among them that was new."""
    steps_judged: Tensor
    """How many steps were taken since."""
    given_up: Tensor
    """Detections, by number, that have no say."""
    unjudged: Tensor
    """Detections, by number, that came after all others had been judged."""
    prior_scale: Tensor
    """By journey, how far bias, drift, rotation and the bias's wander, if any, are from the sigmas of `prior`."""
    white_scale: Tensor
    """By journey and number of a pose, how far its noise from frame to frame is from that of `prior`."""
    calibration_scale: Tensor
    """By kind of what cars may have wrong, how far they are from the sigmas of `fleet`."""
    calibration_far: Tensor
    """By car and number, how far it is beyond these sigmas as they are."""
    drift_told: Tensor
    """By journey and number of a pose, the share of the drift's changes that observations tell; zero before."""
    poses_left: Tensor
    """Variance that is left of every pose's deviation from its drift."""
    held_off: Tensor
    """By detection of corners, how strongly its sign and its camera are held off each other [m] at most (`noise_pull`)."""
    innovation: Tensor
    """By detection of corners, how far all else foresees it shifted, and by what (`detection_shifts`)."""
    share_there: Tensor
    """Share of the variances of poses' errors, as they are taken for, that is there."""
    strides: Tensor
    """How shifts and that share were followed the last time (`Followed.stride`)."""
    told_at: Tensor
    """The scales by which all these were found; NaN before."""

    def __init__(
        self,
        unknowns: Unknowns,
        observations: Observations,
        priors: Priors,
        config: AdjustConfig,
        shared_out: SharedOut | None = None,
    ) -> None:
        super().__init__()
        self.together = ALONE if shared_out is None else shared_out.together
        values, corners = unknowns.values, observations.corners
        self._detections = KeptDetections()
        self.fleet, self.config = priors.fleet, config
        own = {
            name: Variable(values[name].shape[1], euclidean, pull=pull_euclidean)
            for name in self.fleet.start
        }
        self.variables = VARIABLES | own
        wide = values["drift"].shape[1]
        for name in ("drift", "cut"):
            dim = values[name].shape[1]
            self.variables[name] = replace(VARIABLES[name], tangent_dim=dim)
        self.names = tuple(values)
        for name, value in values.items():
            self.register_buffer(f"base_{name}", value.clone())
            increment = value.new_zeros(len(value), self.variables[name].tangent_dim)
            self.register_parameter(f"delta_{name}", nn.Parameter(increment))
        self.register_buffer("scale", values["pose"].new_full((3,), torch.inf))
        self.register_buffer("small_box", torch.zeros_like(self.scale[0]))
        self.register_buffer("lasting", torch.zeros_like(self.scale[:2]))
        self.register_buffer("lasting_each", torch.zeros_like(self.lasting))
        last = int(corners.detection.max()) + 1 if len(corners) else 0
        last = last if shared_out is None else shared_out.detections
        given_up = torch.zeros(last, dtype=torch.bool, device=self.scale.device)
        self.register_buffer("given_up", given_up)
        self.register_buffer("unjudged", torch.zeros_like(given_up))
        self.register_buffer("judged", torch.zeros_like(given_up, dtype=torch.long).sum())
        self.register_buffer("steps_judged", torch.zeros_like(self.judged))
        self.register_buffer(
            "prior_scale", values["bias"].new_ones(len(values["bias"]), priors.poses.scale_count)
        )
        self.register_buffer("white_scale", torch.ones_like(values["bias"]))
        self.register_buffer("calibration_scale", self.scale.new_ones(len(self.fleet.kinds)))
        numbers = sum(self.variables[name].tangent_dim for name in self.fleet.variables)
        far = self.scale.new_ones(len(self.fleet.vehicles), numbers)
        self.register_buffer("calibration_far", far)
        self.register_buffer("drift_told", values["bias"].new_zeros(len(values["bias"]), wide))
        self.register_buffer("poses_left", values["pose"].new_zeros(len(values["pose"]), 6))
        self.register_buffer("held_off", values["pose"].new_zeros(0))
        self.register_buffer("innovation", values["pose"].new_zeros(0, 3))
        self.register_buffer("share_there", torch.ones_like(self.scale[0]))
        self.register_buffer("strides", torch.zeros_like(self.lasting))
        self.register_buffer("told_at", torch.full_like(self.scales(), torch.nan))
        self.frame, self.lane_count = unknowns.frame, unknowns.lane_count
        # Their matrices are the bundle's own: lenses are taken anew in place.
        points = observations.lane_points
        self.see(replace(corners, matrix=corners.matrix.clone()))
        self.lane_points = replace(points, matrix=points.matrix.clone())
        self.lenses = observations.lenses
        self.prior, self.fixed, self.beside = priors.poses, priors.fixed, priors.beside
        self.course = priors.course
        # Where each lane point was followed to is part of the state: matching starts from there.
        matches = observations.matches
        self._match_lane, self._match_begun = matches.lane, matches.t
        self.register_buffer("match_t", matches.t.clone())
        self.register_buffer("match_normal", matches.normal_px.clone())
        self.register_buffer("match_valid", matches.valid.clone())
        self.register_buffer("refreshed", torch.zeros_like(self.judged, dtype=torch.bool))
        self._by_optics = _no_derivatives(self.fleet, self.corners, self.lane_points)
        self._by_mount = self.fleet.by_mount(values["pose"])
        self._backend: ChainBackend | JourneyBackend | None = None

    @property
    def of_drives(self) -> tuple[str, ...]:
        """The unknowns that each drive has of its own for good."""
        return ("bias",) if self.course is None else ("bias", "stance")

    def pose_terms(self, prior_scale: Float[Tensor, "j _"]) -> dict[str, CostTerm]:
        """What is known of poses beside images: how far positioning may be off, and where cars point."""
        terms = self.prior.terms(prior_scale, self.white_scale)
        terms["pose_white"] = self.fleet.of_poses(terms["pose_white"], self._by_mount)
        if self.course is not None:
            terms |= self.course.terms(self.prior.white_sigma, self.white_scale)
        return terms

    @property
    def matches(self) -> LaneMatches:
        """The spline point that each lane point is held against."""
        return LaneMatches(self._match_lane, self.match_t, self.match_normal, self.match_valid)

    @cached_property
    def convoys(self) -> list[tuple[int, int]]:
        """The drives that are adjusted together, as the first of some and the one behind their last (`convoys`)."""
        nodes, count = self.prior.nodes, len(self.prior_scale)
        return convoys(nodes.journey, nodes.way, count, self.config.convoy_m)

    @property
    def lane_axes(self) -> Float[Tensor, "c 3 3"]:
        """Along every lane coefficient's marker, to its left along the road, and up from that; the columns."""
        if "lane_prior" not in self.fixed:
            return self.scale.new_zeros(0, 3, 3)
        return self.fixed["lane_prior"].constants[1]

    @property
    def begun_matches(self) -> LaneMatches:
        """Where each lane point's match began, which it keeps near."""
        return replace(self.matches, t=self._match_begun)

    @property
    def unknown_names(self) -> set[str]:
        """The unknowns' names in `state_dict()`."""
        return {f"{part}_{name}" for part in ("base", "delta") for name in self.names}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> BundleState:
        """What `.to(device)` calls: the tables follow the unknowns."""
        super()._apply(fn, recurse)
        self._backend = None
        self.__dict__.update(to_device(vars(self), self.scale.device))
        return self

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **options: Any) -> Any:
        """Goes on where another bundle stood; the lenses follow the unknowns, so they are not in the dictionary."""
        found = super().load_state_dict(state_dict, *args, **options)
        self.relinearise()
        return found

    def values(self) -> dict[str, Tensor]:
        """Base values moved by the increments."""
        return {
            name: self.variables[name].retract(
                getattr(self, f"base_{name}"), getattr(self, f"delta_{name}")
            )
            for name in self.names
        }

    @torch.no_grad()
    def fold(self, values: dict[str, Tensor]) -> None:
        """Makes `values` the base and sets the increments to zero."""
        for name in self.names:
            getattr(self, f"base_{name}").copy_(values[name])
            getattr(self, f"delta_{name}").zero_()

    @torch.no_grad()
    def relinearise(self) -> None:
        """Takes every lens as it is where the unknowns, and the splines' matches, have the points by now."""
        values = self.values()
        self._by_mount = self.fleet.by_mount(values["pose"])
        by_corner, by_point = self._by_optics
        relinearise(
            Linearised(self.corners, by_corner, self.lane_points, by_point),
            values,
            *(self.matches, self.lane_count, self.lenses),
            self.fleet,
            self.lane_axes[:, :, 1],
        )

    def see(self, corners: CornerObservations) -> None:
        """Takes these corners of signs for those that were seen; nothing is held off by their detections yet."""
        self.corners = corners
        self.held_off = self.scale.new_zeros(len(self.detections.count))
        self.innovation = self.scale.new_zeros(len(self.held_off), 3)

    def rest(self) -> None:
        """Puts the observations, which others have, into a file, and forgets what follows from them until `relinearise`."""
        self.corners, self.lane_points = rest((self.corners, self.lane_points))
        self._by_optics = _no_derivatives(self.fleet, self.corners, self.lane_points)

    def forget_factors(self) -> None:
        """Lets the solver's memory go."""
        self._backend = None

    @property
    def calibration_scales(self) -> CalibrationScales:
        """How far cars are from the sigmas of `fleet`."""
        return CalibrationScales(self.calibration_scale, self.calibration_far)

    @property
    def detections(self) -> CornerDetections:
        """The detections of the corners."""
        return self._detections.of(self.corners)

    def scales(self) -> Float[Tensor, " s"]:
        """All scales that weigh observations and the prior, and how often detections were judged."""
        corner = (self.scale[0].square() + self.lasting[0]).sqrt()
        size = _SIZE_FELT + self.lasting[1].sqrt()
        judged = 1.0 + self.judged - 0.5 * self.unjudged.any()
        of_pixels = (self.scale[1:], corner[None], size[None], judged[None])
        return torch.cat((self.prior_scale.flatten(), self.white_scale.flatten(), *of_pixels))


def _no_derivatives(
    fleet: Fleet, corners: CornerObservations, points: LanePointObservations
) -> tuple[ByOptics, ByOptics]:
    """Those by optics of corners and lane points of which none are known."""
    of_corners = ByOptics.none(len(corners), fleet.config, corners.px, 0)
    return of_corners, ByOptics.none(len(points), fleet.config, points.px, 1)
