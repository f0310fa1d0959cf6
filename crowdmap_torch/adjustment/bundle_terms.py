"""The problem that the unknowns and observations of bundle adjustment make: its terms (V-B, eq:ba)."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment import calibration_priors
from crowdmap_torch.adjustment.bundle_state import BundleState
from crowdmap_torch.adjustment.landmark_terms import about_usual_size, size_class_term, slide_term
from crowdmap_torch.adjustment.lane_terms import lane_point_terms
from crowdmap_torch.adjustment.noise_pull import noise_pull_term
from crowdmap_torch.adjustment.observations import CornerObservations
from crowdmap_torch.adjustment.shared_corner_errors import Lasting, shared_errors
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.optim.problem import CostTerm, Problem
from crowdmap_torch.optim.robust import JointTukey, Tukey
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.elimination import planned_ahead
from crowdmap_torch.optim.solvers.journey_system import JourneyBackend
from crowdmap_torch.optim.solvers.normal_equations import MapBackend
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.residuals import reprojection

_PIXEL_DIM = 2
"""Numbers of a corner's residual: u and v."""
_FIRST_REACH = 2.0
"""Factor by which the bound on a detection's error is wider until detections are judged: a wrong start gives up few."""
_NEW_REACH = 10.0
"""Likewise for detections of signs that come as an adjustment begins again: no pose knows of them, and noise is narrow."""


class BundleTerms(BundleState):
    """The problem that unknowns and observations make, by the scales of the moment."""

    plan: EliminationPlan
    """The order that unknowns are eliminated in."""

    @torch.no_grad()
    def elimination(self) -> EliminationPlan:
        """Frames hang on the drift's chains, both are eliminated; what drives have to themselves or share goes last.

        Landmarks are ranked as they start. Lane points slide to the next control point and no further: the order that is
        found here is kept.
        """
        prior, terms = self.prior, (self._corner_term, self._lane_terms)
        seen = {name: term for make in terms for name, term in make(1.0).items()}
        of_poses = self.pose_terms(self.prior_scale)
        seen |= {name: term for name, term in of_poses.items() if "cut" in dict(term.slots)}
        of_journey = prior.journey_of_chain
        plan = EliminationPlan(
            *("drift", prior.chain, "pose", prior.nodes.of_frame),
            border=dict.fromkeys(self.of_drives, of_journey) | self.fleet.blocks(of_journey),
            joints="cut",
            joint=prior.joint,
        )
        problem = Problem(self.variables, {**seen, **self._slide_term()})
        lane, _ = spline_basis.rows(self.lane_count)
        return planned_ahead(problem, self.values(), plan, sliding={"lane": lane})

    def backend(self) -> MapBackend:
        """The solver's back end, with the order of elimination and the memory that the last problem took."""
        if self._backend is None:
            alone = self.together.is_alone
            self._backend = (
                ChainBackend(self.plan) if alone else JourneyBackend(self.plan, self.together)
            )
        return self._backend

    def problem(self) -> Problem:
        """The least-squares problem with the matches and scales of the moment, lanes held where they are."""
        held = self._slide_term() | self._hold_off_term()
        return self._problem({**self._terms(self.prior_scale), **held})

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
        if self.together.is_alone:
            return Problem(self.variables, terms)
        common = frozenset(self.variables) - frozenset(self.plan.first_block)
        terms = {name: term for name, term in terms.items() if len(term)}
        return Problem(self.variables, terms, together=self.together, common=common)

    def _terms(self, prior_scale: Float[Tensor, "j _"]) -> dict[str, CostTerm]:
        """By name, beside what holds landmarks where they are."""
        terms = self.pose_terms(prior_scale)
        if self.together.leads:
            terms |= self.fixed | calibration_priors.priors(self.fleet, self.calibration_scales)
            size = self.values()["size"]
            terms |= size_class_term(size, self.config)
            if "sign_habit" in terms:
                habit = about_usual_size(terms["sign_habit"], size, self.config.habit)
                terms["sign_habit"] = habit
        terms.update(self._corner_term(self.corner_sigma()))
        terms.update(self._lane_terms(float(self.scale[1] * self.scale[2])))
        return terms

    def corner_sigma(self) -> Float[Tensor, " m"]:
        """Standard deviation of every sign corner in u and in v [px]."""
        return self._sigma_of(self.corners)

    def _sigma_of(self, rows: CornerObservations) -> Float[Tensor, " m"]:
        variance = self.scale[0].square() * (1 + (self.small_box / rows.box_px).square())
        return (variance + rows.loose_px.square()).sqrt()

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
        if isinstance(sigma, Tensor):
            lasting = Lasting(self.lasting, self.lasting_each)
            how = rows.px, sigma, lasting, ~self.given_up[rows.detection]
            term = replace(term, shared=shared_errors(self.detections, *how))
        return {"sign_reprojection": self.fleet.of_corners(term, rows, self._by_optics[0])}

    def _loss_of_detections(self) -> JointTukey:
        """The loss of whole detections, those that are given up of no account."""
        detection = self.corners.detection
        reach = _FIRST_REACH if int(self.judged) == 0 else 1.0
        bound = self.scale.new_tensor(self.config.tukey_c * reach)
        loss = JointTukey.by_efficiency(detection, bound, row_dim=_PIXEL_DIM)
        loss = loss.wider(torch.where(self.unjudged[detection], _NEW_REACH, 1.0).to(bound))
        return loss.without(self.given_up[detection])

    def _hold_off_term(self) -> dict[str, CostTerm]:
        if not len(self.corners) or self.config.method == "paper2017":
            return {}
        rows, first = self.corners, self.detections.first
        strength = (1 - self.share_there).clamp_min(0).sqrt() * self.held_off
        return {"noise_pull": noise_pull_term(rows.frame[first], rows.sign[first], strength)}

    def _slide_term(self) -> dict[str, CostTerm]:
        if not len(self.lane_points):
            return {}
        values, along = self.values(), self.lane_axes[:, :, 0]
        return slide_term(values["pose"], values["lane"], self.beside, along, self.config)

    def _lane_terms(self, sigma: float) -> dict[str, CostTerm]:
        rows = self.lane_points
        if not len(rows):
            return {}
        terms = lane_point_terms(rows, self.matches, self.lane_count, sigma, self.config.tukey_c)
        return self.fleet.of_lane_points(terms, rows, self.matches.normal_px, self._by_optics[1])
