"""The unknowns of bundle adjustment, the observations of them, and the problem that they make (V-B, eq:ba)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from crowdmap_torch.adjustment.calibration import ByOptics
from crowdmap_torch.adjustment.calibration_scales import rescaled as rescaled_calibrations
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.landmark_terms import size_class_term, slide_term
from crowdmap_torch.adjustment.lane_matching import LaneMatches, follow
from crowdmap_torch.adjustment.lane_terms import lane_point_terms
from crowdmap_torch.adjustment.lenses import rows_by_lens
from crowdmap_torch.adjustment.parts import VARIABLES, Observations, Priors, Unknowns
from crowdmap_torch.adjustment.pixel_scales import PixelErrors, pixel_scales
from crowdmap_torch.adjustment.relinearisation import Relinearised, relinearised_at
from crowdmap_torch.adjustment.shared_corner_errors import (
    KeptDetections,
    lasting_variance,
    shared_errors,
)
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.noise.pose_evidence import PoseEvidence, white_scales
from crowdmap_torch.noise.pose_prior import CUT_TERMS
from crowdmap_torch.optim.innovation_gate import innovations
from crowdmap_torch.optim.linearize import residuals as whitened_residuals
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean, pull_euclidean
from crowdmap_torch.optim.robust import JointTukey, Tukey
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.elimination import planned_ahead
from crowdmap_torch.optim.solvers.normal_equations import BorderInformation, MapBackend
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.residuals import reprojection
from crowdmap_torch.tables import to_device

_PIXEL_DIM = 2
"""Numbers of a corner's residual: u and v."""
_FIRST_REACH = 2.0
"""Factor by which the bound on a detection's error is wider until detections are judged: a wrong start gives up few."""
_MOST_JUDGEMENTS = 2
"""Detections are judged no more often than this, should some of them come and go."""
_NARROWS = 0.97
"""A scale of pixels that would not fall below this share of itself is at rest, and stays as it is."""
_SCALE_STAYS = 0.005
"""A scale of the prior that would change by less than this share stays as it is: the cost is to fall from step to step."""
_SCALE_RESTS = 0.05
"""Scales of the prior of which none would change by more than this share are at rest: they are not known any better."""
_CALIBRATION_RESTS = 0.2
"""Likewise of calibrations, which rest on few numbers: a fifth of a prior's sigma moves a map by nothing that shows."""
_TOLD_HOLDS = 0.02
"""What observations tell of poses' errors is found anew where any scale has changed by more than this share since."""
_WHITE_RESTS = 0.03
"""A scale of the poses' noise from frame to frame that would change by less than this share is at rest."""
_LASTING_RESTS = 0.1
"""The variance of a detection's shift that would change by less than this share is at rest."""


class Bundle(nn.Module):
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
    """Variance [px^2] of a detection's shift, in the mean of many successive ones, beyond its corners' noise."""
    judged: Tensor
    """How often detections were judged by everything else."""
    given_up: Tensor
    """Detections, by number, that have no say."""
    prior_scale: Tensor
    """By journey, how far bias, drift, rotation and the bias's wander, if any, are from the sigmas of `prior`."""
    white_scale: Tensor
    """By journey, how far the noise of positions and of rotations from frame to frame is from that of `prior`."""
    calibration_scale: Tensor
    """By kind of what cars may have wrong, how far they are from the sigmas of `fleet`."""
    drift_told: Tensor
    """By journey and number of a pose, the share of the drift's changes that observations tell."""
    poses_left: Tensor
    """Variance that is left of every pose's deviation from its drift."""
    told_at: Tensor
    """The scales by which both were found; NaN before."""

    def __init__(
        self, unknowns: Unknowns, observations: Observations, priors: Priors, config: AdjustConfig
    ) -> None:
        super().__init__()
        values, corners = unknowns.values, observations.corners
        self.fleet, self.config = priors.fleet, config
        own = {
            name: Variable(values[name].shape[1], euclidean, pull=pull_euclidean)
            for name in self.fleet.start
        }
        self.variables = VARIABLES | own
        wide = values["drift"].shape[1]
        for name in ("drift", "cut"):
            self.variables[name] = replace(VARIABLES[name], tangent_dim=wide)
        self.names = tuple(values)
        for name, value in values.items():
            self.register_buffer(f"base_{name}", value.clone())
            increment = value.new_zeros(len(value), self.variables[name].tangent_dim)
            self.register_parameter(f"delta_{name}", nn.Parameter(increment))
        self.register_buffer("scale", values["pose"].new_full((3,), torch.inf))
        self.register_buffer("small_box", torch.zeros_like(self.scale[0]))
        self.register_buffer("lasting", torch.zeros_like(self.scale[0]))
        last = int(corners.detection.max()) + 1 if len(corners) else 0
        given_up = torch.zeros(last, dtype=torch.bool, device=self.scale.device)
        self.register_buffer("given_up", given_up)
        self.register_buffer("judged", torch.zeros_like(given_up, dtype=torch.long).sum())
        self.register_buffer(
            "prior_scale", values["bias"].new_ones(len(values["bias"]), priors.poses.scale_count)
        )
        self.register_buffer("white_scale", torch.ones_like(values["bias"][:, :2]))
        self.register_buffer("calibration_scale", self.scale.new_ones(len(self.fleet.kinds)))
        self.register_buffer("drift_told", values["bias"].new_ones(len(values["bias"]), wide))
        self.register_buffer("poses_left", values["pose"].new_zeros(len(values["pose"]), 6))
        self.register_buffer("told_at", torch.full_like(self._scales(), torch.nan))
        self.frame, self.lane_count = unknowns.frame, unknowns.lane_count
        self.corners, self.lane_points = corners, observations.lane_points
        self.lenses = observations.lenses
        self._corners_by_lens = rows_by_lens(self.corners, self.lenses)
        self._lane_points_by_lens = rows_by_lens(self.lane_points, self.lenses)
        self.prior, self.fixed, self.beside = priors.poses, priors.fixed, priors.beside
        # Where each lane point was followed to is part of the state: matching starts from there.
        matches = observations.matches
        self._match_lane, self._match_begun = matches.lane, matches.t
        self.register_buffer("match_t", matches.t.clone())
        self.register_buffer("match_normal", matches.normal_px.clone())
        self.register_buffer("match_valid", matches.valid.clone())
        self.register_buffer("refreshed", torch.zeros_like(self.judged, dtype=torch.bool))
        self._by_optics = tuple(
            ByOptics.none(len(rows), self.fleet.config, rows.px, heights)
            for rows, heights in ((self.corners, 0), (self.lane_points, 1))
        )
        self._by_mount = self.fleet.by_mount(values["pose"])
        self._detections = KeptDetections()
        self._plan = self._elimination()
        self._backend: ChainBackend | None = None

    @torch.no_grad()
    def _elimination(self) -> EliminationPlan:
        """Frames hang on the drift's chains, both are eliminated; what drives have to themselves or share goes last.

        Landmarks are ranked as they start. Lane points slide to the next control point and no further: the order that is
        found here is kept.
        """
        prior, terms = self.prior, (self._corner_term, self._lane_terms)
        seen = {name: term for make in terms for name, term in make(1.0).items()}
        at_cuts = prior.terms(self.prior_scale, self.white_scale)
        seen |= {name: at_cuts[name] for name in CUT_TERMS if name in at_cuts}
        of_journey = prior.journey_of_chain
        plan = EliminationPlan(
            *("drift", prior.chain, "pose", prior.nodes.of_frame),
            border={"bias": of_journey, **self.fleet.blocks(of_journey)},
            joints="cut",
            joint=prior.joint,
        )
        problem = Problem(self.variables, {**seen, **self._slide_term()})
        lane, _ = spline_basis.rows(self.lane_count)
        return planned_ahead(problem, self.values(), plan, sliding={"lane": lane})

    @property
    def matches(self) -> LaneMatches:
        """The spline point that each lane point is held against."""
        return LaneMatches(self._match_lane, self.match_t, self.match_normal, self.match_valid)

    @property
    def unknown_names(self) -> set[str]:
        """The unknowns' names in `state_dict()`."""
        return {f"{part}_{name}" for part in ("base", "delta") for name in self.names}

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Bundle:
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

    def backend(self) -> ChainBackend:
        """The solver's back end, with the order of elimination and the memory that the last problem took."""
        self._backend = self._backend or ChainBackend(self._plan)
        return self._backend

    @torch.no_grad()
    def refresh(
        self, evidence: PoseEvidence | None = None, of_border: BorderInformation | None = None
    ) -> bool:
        """Matches lanes anew and narrows the scales; returns whether the scales have come to rest.

        The scales of pixels start at what the residuals show, so that a wrong start does not make outliers of
        everything, and fall as the fit improves; they never grow again. What detections of a sign have wrong together is
        told from zero on once they are at rest: before that it is the drift. Those of the poses' prior follow the drift and
        the noise about it, as far as there is `evidence` of them, those of calibrations what `of_border` tells of cars.
        """
        values, made_with = self.values(), self._scales()
        if len(self.lane_points):
            pose = values["pose"][self.lane_points.frame]
            splines = values["lane"], self.lane_count
            begun = self._match_begun
            found = follow(self.matches, self.lane_points, pose, *splines, begun=begun)
            self.match_t, self.match_normal = found.t, found.normal_px
            self.match_valid = found.valid
        self.relinearise()
        at_rest = self._narrow(values)
        if evidence is not None:
            if evidence.told is not self.drift_told:
                self.told_at.copy_(made_with)
                self.drift_told.copy_(evidence.told)
                self.poses_left.copy_(evidence.left)
            at_rest &= self._rescale_noise(values, evidence)
        if of_border is not None:
            found = rescaled_calibrations(self.fleet, values, of_border, self.calibration_scale)
            at_rest &= self._follow("calibration_scale", found, _SCALE_STAYS, _CALIBRATION_RESTS)
        found = self.prior.rescaled(values["drift"], self.prior_scale, self.drift_told)
        at_rest &= self._follow("prior_scale", found, _SCALE_STAYS, _SCALE_RESTS)
        self.refreshed.fill_(True)
        return at_rest

    def evidence(self) -> PoseEvidence | None:
        """What was found last, as long as the scales are what it was found by; None: it is to be found anew."""
        holds = torch.isclose(self._scales(), self.told_at, rtol=_TOLD_HOLDS, atol=0)
        return PoseEvidence(self.drift_told, self.poses_left) if bool(holds.all()) else None

    def _scales(self) -> Float[Tensor, " s"]:
        """All scales that weigh observations and the prior, and how often detections were judged."""
        corner = (self.scale[0].square() + self.lasting).sqrt()
        of_pixels = (self.scale[1:], corner[None], 1.0 + self.judged[None])
        return torch.cat((self.prior_scale.flatten(), self.white_scale.flatten(), *of_pixels))

    def _rescale_noise(self, values: dict[str, Tensor], evidence: PoseEvidence) -> bool:
        """Finds the noise of poses from frame to frame; returns whether it has come to rest."""
        scales = self.prior_scale, self.white_scale
        term = self.fleet.of_poses(self.prior.terms(*scales)["pose_white"], self._by_mount)
        residual = whitened_residuals(term, values)
        found = white_scales(self.prior, residual, evidence.left, *scales)
        return self._follow("white_scale", found, _WHITE_RESTS, _WHITE_RESTS)

    def _follow(self, name: str, found: Tensor, stays: float, rests: float) -> bool:
        """Puts scales where they are `found`, to the last digit that counts; returns whether they are at rest."""
        scale = getattr(self, name)
        moved = (found / scale).log().abs()
        scale.copy_(torch.where(moved > stays, found, scale))
        return not bool((moved > rests).any())

    @torch.no_grad()
    def relinearise(self) -> None:
        """Takes every lens as it is where the unknowns, and the splines' matches, have the points by now."""
        values = self.values()
        self._by_mount = self.fleet.by_mount(values["pose"])
        by_corner, by_point = self._by_optics
        found = relinearised_at(
            values,
            Relinearised(self.corners, by_corner, self.lane_points, by_point),
            *(self.matches, self.lane_count, self.lenses),
            (self._corners_by_lens, self._lane_points_by_lens),
            self.fleet,
        )
        self.corners, self.lane_points = found.corners, found.lane_points
        self._by_optics = (found.by_corner, found.by_lane_point)

    @torch.no_grad()
    def judge(self, backend: MapBackend) -> bool:
        """Gives detections up that everything else is too much against, at the minimum; returns whether any changed.

        What they are judged by is their innovation: of the nearest view of a sign the residual says little, as the pose
        goes where that view wants it. From the first time on the bound on residuals is as narrow as it is to be.
        """
        if self.config.method == "paper2017" or int(self.judged) >= _MOST_JUDGEMENTS:
            return False
        problem, values, given_up = self.problem(), self.values(), torch.zeros_like(self.given_up)
        if self.config.innovation_chance and len(self.corners):
            of_pose = backend.assemble(problem, values).conditional_covariance("pose")
            term = problem.terms["sign_reprojection"]
            found = innovations(term, self.variables, values, of_pose)
            assert isinstance(term.loss, JointTukey)
            too_large = found.are_too_large(self.config.innovation_chance)
            given_up[self.corners.detection] = too_large[term.loss.run]
        first, changed = int(self.judged) == 0, not torch.equal(given_up, self.given_up)
        self.judged += 1
        self.given_up.copy_(given_up)
        return first or changed

    def _narrow(self, values: dict[str, Tensor]) -> bool:
        """Narrows the scales of pixels to what the residuals show; returns whether they have come to rest."""
        of_corners, of_lanes = self.scale.new_zeros(0, 2), self.scale[:0]
        for term in self._corner_term(1.0).values():
            of_corners = whitened_residuals(term, values)
        matched = torch.nonzero(self.matches.valid)[:, 0]
        if len(self.lane_points):
            term = self._lane_terms(1.0)["lane_reprojection"]
            of_lanes = whitened_residuals(term, values)[matched, 0]
        errors = PixelErrors(self.corners, of_corners, self.lane_points[matched], of_lanes)
        seen, small_box = pixel_scales(errors, self.small_box, self.config)
        narrows = seen < _NARROWS * self.scale
        self.scale.copy_(torch.where(narrows, seen, self.scale))
        self.small_box.copy_(torch.where(narrows[0], small_box, self.small_box))
        return not bool(narrows.any()) and self._lasts(of_corners)

    def _lasts(self, of_corners: Float[Tensor, "m 2"]) -> bool:
        """Finds what lasts of detections' shifts; returns whether it has come to rest."""
        if not len(of_corners) or self.config.method == "paper2017":
            return True
        sigma, counted = self.corner_sigma(), ~self.given_up[self.corners.detection]
        seen = lasting_variance(self._detections.of(self.corners), of_corners, sigma, counted)
        white = self.scale[0].square() / self._detections.of(self.corners).most
        rests = (seen - self.lasting).abs() <= _LASTING_RESTS * (seen + white)
        self.lasting.copy_(torch.where(rests, self.lasting, seen))
        return bool(rests)

    def problem(self) -> Problem:
        """The least-squares problem with the matches and scales of the moment, lanes held where they are.

        Of a bundle that was never refreshed they are found first.
        """
        return self._problem({**self._terms(self.prior_scale), **self._slide_term()})

    def information(self, prior_scale: Float[Tensor, "j _"]) -> Problem:
        """The problem whose Hessian tells what is known: nothing held, `prior_scale` for that of the bundle.

        The weights of detections are raised to what they keep of the information.
        """
        return self._problem(
            {
                name: replace(term, loss=term.loss.informative())
                if isinstance(term.loss, JointTukey)
                else term
                for name, term in self._terms(prior_scale).items()
            }
        )

    def _problem(self, terms: dict[str, CostTerm]) -> Problem:
        """The problem of these terms, with the Jacobians that the configuration asks for."""
        if self.config.jacobians == "autograd":
            terms = {name: term.by_autograd() for name, term in terms.items()}
        return Problem(self.variables, terms)

    def _terms(self, prior_scale: Float[Tensor, "j _"]) -> dict[str, CostTerm]:
        if not bool(self.refreshed):
            self.refresh()
        terms = self.prior.terms(prior_scale, self.white_scale) | self.fixed
        terms |= self.fleet.priors(self.calibration_scale)
        terms["pose_white"] = self.fleet.of_poses(terms["pose_white"], self._by_mount)
        terms.update(size_class_term(self.values()["size"], self.config))
        terms.update(self._corner_term(self.corner_sigma()))
        terms.update(self._lane_terms(float(self.scale[1] * self.scale[2])))
        return terms

    def corner_sigma(self) -> Float[Tensor, " m"]:
        """Standard deviation of every sign corner in u and in v [px]."""
        box, loose = self.corners.box_px, self.corners.loose_px
        variance = self.scale[0].square() * (1 + (self.small_box / box).square())
        return (variance + loose.square()).sqrt()

    def _corner_term(self, sigma: float | Float[Tensor, " m"]) -> dict[str, CostTerm]:
        rows = self.corners
        if not len(rows):
            return {}
        alone = self.config.method == "paper2017"
        loss = Tukey(self.config.tukey_c) if alone else self._loss_of_detections()
        term = CostTerm(
            reprojection.sign_reprojection,
            (("pose", rows.frame), ("sign", rows.sign), ("size", rows.sign)),
            (rows.template, rows.matrix),
            rows.template.new_ones(len(rows)) / sigma,
            loss,
            reprojection.sign_reprojection_jacobian,
        )
        if isinstance(sigma, Tensor) and bool(self.lasting > 0):
            term = replace(
                term, shared=shared_errors(self._detections.of(self.corners), sigma, self.lasting)
            )
        return {"sign_reprojection": self.fleet.of_corners(term, rows, self._by_optics[0])}

    def _loss_of_detections(self) -> JointTukey:
        """The loss of whole detections, those that are given up of no account."""
        detection = self.corners.detection
        reach = _FIRST_REACH if int(self.judged) == 0 else 1.0
        bound = self.scale.new_tensor(self.config.tukey_c * reach)
        loss = JointTukey.by_efficiency(detection, bound, row_dim=_PIXEL_DIM)
        return loss.without(self.given_up[detection])

    def _slide_term(self) -> dict[str, CostTerm]:
        if not len(self.lane_points):
            return {}
        values, along = self.values(), self.fixed["lane_prior"].constants[1][:, :, 0]
        return slide_term(values["pose"], values["lane"], self.beside, along, self.config)

    def _lane_terms(self, sigma: float) -> dict[str, CostTerm]:
        rows = self.lane_points
        if not len(rows):
            return {}
        terms = lane_point_terms(rows, self.matches, self.lane_count, sigma, self.config.tukey_c)
        return self.fleet.of_lane_points(terms, rows, self.matches.normal_px, self._by_optics[1])
