"""The bundle of bundle adjustment, and how its scales follow from step to step (V-B)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.adjustment.bundle_terms import BundleTerms
from crowdmap_torch.adjustment.calibration_scales import rescaled as rescaled_calibrations
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.detection_shifts import shift_innovations, told_apart
from crowdmap_torch.adjustment.lane_matching import follow
from crowdmap_torch.adjustment.noise_pull import held_off, left_by_prior
from crowdmap_torch.adjustment.parts import Observations, Priors, SharedOut, Unknowns
from crowdmap_torch.adjustment.pixel_scales import PixelErrors, pixel_scales
from crowdmap_torch.adjustment.shared_corner_errors import Followed, Lasting, lasting_errors
from crowdmap_torch.noise.pose_evidence import PoseEvidence, pose_evidence, white_scales
from crowdmap_torch.noise.pose_prior import WANDER_SCALE
from crowdmap_torch.optim.innovation_gate import innovations
from crowdmap_torch.optim.linearize import first_blocks
from crowdmap_torch.optim.linearize import residuals as whitened_residuals
from crowdmap_torch.optim.problem import CostTerm, Values
from crowdmap_torch.optim.robust import JointTukey
from crowdmap_torch.optim.solvers.normal_equations import BorderInformation, MapEquations

_MOST_JUDGEMENTS = 2
"""Detections are judged no more often than this, should some of them come and go."""
_NARROWS = 0.97
"""A scale of pixels that would not fall below this share of itself is at rest, and stays as it is."""
_SCALE_STAYS = 0.005
"""A scale of the prior that would change by less than this share stays as it is: the cost is to fall from step to step."""
_SCALE_RESTS = 0.05
"""Scales of the prior of which none would change by more than this share are at rest: they are not known any better."""
_WANDER_RESTS = 0.1
"""Likewise of the wander of biases: where there is none it shrinks step by step, and what is side by side stays there."""
_CALIBRATION_RESTS = 0.2
"""Likewise of calibrations, which rest on few numbers: a fifth of a prior's sigma moves a map by nothing that shows."""
_TOLD_HOLDS = 0.02
"""What observations tell of poses' errors is found anew where any scale has changed by more than this share since."""
_WHITE_RESTS = 0.03
"""A scale of the poses' noise from frame to frame that would change by less than this share is at rest."""
_FEW = 0.1
"""Detections are first judged when the scales of all but this share of the drives are at rest; once more when all are."""


@dataclass(frozen=True)
class Evidence(PoseEvidence):
    """What the observations of a bundle tell of its poses' errors, and how far these draw signs near."""

    held_off: Float[Tensor, " d"]
    """By detection of corners (`noise_pull`)."""
    innovation: Float[Tensor, "d 3"]
    """Likewise (`detection_shifts`)."""


@dataclass(frozen=True)
class AtRest:
    """Which scales a refresh found to be at rest, and left all but as they were."""

    scales: bool
    """All of them."""
    judging: bool
    """Those that detections are judged by: of the noise of corners and, of most drives, of the poses' prior and noise; but
    for the wander of biases, by which a sign's views are off alike."""


class Bundle(BundleTerms):
    """What is adjusted: the problem that unknowns and observations make, with scales that follow from step to step."""

    _others: Bundle | None

    def __init__(
        self,
        unknowns: Unknowns,
        observations: Observations,
        priors: Priors,
        config: AdjustConfig,
        shared_out: SharedOut | None = None,
        whole: Bundle | None = None,
    ) -> None:
        """All drives, or such as are `shared_out`; their leader has the `whole` beside it, with everybody's observations."""
        super().__init__(unknowns, observations, priors, config, shared_out)
        self.plan = self.elimination() if shared_out is None else shared_out.plan
        # Not a module of this one.
        object.__setattr__(self, "_others", whole)

    @property
    def whole(self) -> Bundle:
        """That of all drives: itself, but of the leader of some that are shared out."""
        return self._others or self

    def _terms(self, prior_scale: Float[Tensor, "j _"]) -> dict[str, CostTerm]:
        """Of a bundle that was never refreshed matches and scales are found first."""
        if not bool(self.refreshed):
            self.refresh()
        return super()._terms(prior_scale)

    @torch.no_grad()
    def refresh(
        self,
        evidence: Evidence | None = None,
        of_border: BorderInformation | None = None,
        waits: bool = False,
    ) -> AtRest:
        """Matches lanes anew and narrows the scales; returns which of them have come to rest.

        The scales of pixels start at what the residuals show, so that a wrong start makes no outliers of all, and fall
        as the fit improves; they never grow again. What detections of a sign have wrong together is told from zero on once
        that of corners is at rest: before that it is the drift. Those of the poses' prior follow the drift and the noise
        about it by the `evidence`, those of calibrations what `of_border` tells of cars; none while noise `waits`.
        """
        values, made_with = self.values(), self.scales()
        if len(self.lane_points):
            pose = values["pose"][self.lane_points.frame]
            found = follow(
                *(self.matches, self.lane_points, pose, values["lane"], self.lane_count),
                shifts=self.fleet.shifts(self.lane_points, self._by_optics[1], values),
                begun=self._match_begun,
            )
            self.match_t, self.match_normal = found.t, found.normal_px
            self.match_valid = found.valid
        self.relinearise()
        foreseen = False
        if evidence is not None and evidence.told is not self.drift_told:
            foreseen = True
            self.told_at.copy_(made_with)
            self.drift_told.copy_(evidence.told)
            self.poses_left.copy_(evidence.left)
            self.held_off.copy_(evidence.held_off)
            self.innovation.copy_(evidence.innovation)
        judging, at_rest = self._narrow(values, foreseen)
        self.refreshed.fill_(True)
        if waits:
            return AtRest(at_rest and judging, judging)
        creeps: list[Tensor] = []
        if evidence is not None:
            creeps.append(self._rescale_noise(values, evidence))
        if of_border is not None:
            scaled = self.fleet, values, of_border, self.calibration_scales
            of_cars = self.together.of_all(lambda: rescaled_calibrations(*scaled))
            moved = of_cars.ratio_to(self.calibration_scales).log().abs()
            at_rest &= not bool((moved > _CALIBRATION_RESTS).any())
            self._move("calibration_scale", of_cars.of_kind)
            self._move("calibration_far", of_cars.far)
        found = self.together.of_all(
            lambda drift: self.whole.prior.rescaled(drift, self.prior_scale, self.drift_told),
            values["drift"],
        )
        moved = self._move("prior_scale", found) / _SCALE_RESTS
        moved[:, WANDER_SCALE:] *= _SCALE_RESTS / _WANDER_RESTS
        creeps.append(moved[:, :WANDER_SCALE])
        creep = float((torch.cat(creeps, dim=1) > 1).any(1).double().mean())
        rest = at_rest and judging and creep == 0 and not bool((moved > 1).any())
        return AtRest(rest, judging and creep <= _FEW + 1e-6)

    def evidence(self) -> Evidence | None:
        """What was found last, as long as the scales are what it was found by; None: it is to be found anew."""
        holds = torch.isclose(self.scales(), self.told_at, rtol=_TOLD_HOLDS, atol=0)
        found = self.drift_told, self.poses_left, self.held_off, self.innovation
        return Evidence(*found) if bool(holds.all()) else None

    def told_by(self, equations: MapEquations, corners: CostTerm | None) -> Evidence:
        """What normal equations solved at the bundle's scales, and their term of `corners`, tell of poses' errors."""
        off, innovation = self.held_off, self.innovation
        found = pose_evidence(self.prior, equations, self.prior_scale)
        if corners is not None and len(off) and self.config.method != "paper2017":
            values, detections = self.values(), self.detections
            runs = detections.run, len(off)
            of_pose = equations.conditional_covariance("pose")
            by_prior = left_by_prior(equations, of_pose)
            _, gradient, tells = first_blocks(corners, self.variables, values, *runs)
            whose = self.corners.journey, len(found.told)
            off = held_off(corners, detections, values, tells, by_prior, *whose)
            seen = corners, detections, self.variables, values
            innovation = shift_innovations(*seen, gradient, tells, of_pose, by_prior)
        return Evidence(self._of_journeys(found.told), found.left, off, innovation)

    def _of_journeys(self, own: Float[Tensor, "j k"]) -> Float[Tensor, "j k"]:
        """What there is of every journey, each told by whoever has it."""
        told, mine = torch.zeros_like(own), self.prior.journeys
        told[mine] = own[mine]
        return self.together.sum(told)

    def _rescale_noise(self, values: Values, evidence: PoseEvidence) -> Float[Tensor, "j 6"]:
        """Finds the noise of poses from frame to frame; the logarithms of what it changes by, where it rests below one."""
        scales = self.prior_scale, self.white_scale
        term = self.pose_terms(self.prior_scale)["pose_white"]
        residual = whitened_residuals(term, values) if len(term) else self.poses_left
        found = self._of_journeys(white_scales(self.prior, residual, evidence.left, *scales))
        return self._move("white_scale", found, _WHITE_RESTS) / _WHITE_RESTS

    def _move(self, name: str, found: Tensor, stays: float = _SCALE_STAYS) -> Tensor:
        """Puts scales where they are `found`, to the last digit that counts; the logarithms of what they change by."""
        scale = getattr(self, name)
        moved = (found / scale).log().abs()
        scale.copy_(torch.where(moved > stays, found, scale))
        return moved

    @torch.no_grad()
    def judge(self, equations: MapEquations) -> bool:
        """Gives detections up that everything else is too much against, at the minimum; returns whether any changed.

        What they are judged by is their innovation: of the nearest view of a sign the residual says little, as the pose
        goes where that view wants it. How well poses are known the `equations` tell that were solved last. From the first
        time on the bound on residuals is as narrow as it is to be.
        """
        if self.config.method == "paper2017" or int(self.judged) >= _MOST_JUDGEMENTS:
            return False
        problem, values, given_up = self.problem(), self.values(), torch.zeros_like(self.given_up)
        if self.config.innovation_chance and len(self.whole.corners):
            if len(self.corners):
                of_pose = equations.conditional_covariance("pose")
                term = problem.terms["sign_reprojection"]
                found = innovations(term, self.variables, values, of_pose)
                assert isinstance(term.loss, JointTukey)
                too_large = found.are_too_large(self.config.innovation_chance)
                given_up[self.corners.detection] = too_large[term.loss.run]
            given_up = self.together.sum(given_up.long()) > 0
        first, changed = int(self.judged) == 0, not torch.equal(given_up, self.given_up)
        self.judged += ~self.unjudged.any()
        self.given_up.copy_(given_up)
        self.unjudged.fill_(False)
        return first or changed

    def _narrow(self, values: dict[str, Tensor], foreseen: bool) -> tuple[bool, bool]:
        """Narrows the scales of pixels to what the residuals show; whether those of corners and the others are at rest.

        What detections have wrong together is told where they were `foreseen` anew.
        """
        of_corners, of_lanes = self.scale.new_zeros(0, 2), self.scale[:0]
        for term in self._corner_term(1.0).values():
            of_corners = whitened_residuals(term, values)
        if len(self.lane_points):
            term = self._lane_terms(1.0)["lane_reprojection"]
            of_lanes = whitened_residuals(term, values)[:, 0]
        rows = of_corners, of_lanes, self.match_valid
        seen, small_box = self.together.of_all(self._seen_scales, *rows)
        narrows = seen < _NARROWS * self.scale
        self.scale.copy_(torch.where(narrows, seen, self.scale))
        self.small_box.copy_(torch.where(narrows[0], small_box, self.small_box))
        corners, *lanes = narrows.tolist()
        if corners or not foreseen or self.config.method == "paper2017":
            return not corners, not any(lanes)
        now, rests = self.together.of_all(self._seen_lasting, of_corners, self.innovation)
        self.lasting.copy_(now.lasting.of_many)
        self.lasting_each.copy_(now.lasting.of_each)
        self.share_there.copy_(now.share)
        self.strides.copy_(now.stride)
        lasting_rests, share_rests = rests.tolist()
        return lasting_rests, share_rests and not any(lanes)

    def _seen_scales(
        self,
        of_corners: Float[Tensor, "m 2"],
        of_lanes: Float[Tensor, " k"],
        is_matched: Bool[Tensor, " k"],
    ) -> tuple[Float[Tensor, " 3"], Float[Tensor, ""]]:
        """The scales of pixels by the errors of all corners and lane points, everybody's."""
        matched, whole = torch.nonzero(is_matched)[:, 0], self.whole
        lanes = whole.lane_points[matched], of_lanes[matched]
        errors = PixelErrors(whole.corners, of_corners, *lanes)
        return pixel_scales(errors, self.small_box, self.config)

    def _seen_lasting(
        self, of_corners: Float[Tensor, "m 2"], innovation: Float[Tensor, "d 3"]
    ) -> tuple[Followed, Bool[Tensor, " 2"]]:
        """What lasts of shifts and of sizes by the errors of all, what share of poses' is there, and whether both rest.

        From the second time on shifts and that share go half of the way to where they are found, or less, by what they were.
        """
        before = Followed(Lasting(self.lasting, self.lasting_each), self.share_there, self.strides)
        if not len(of_corners):
            return before, self.given_up.new_ones(2)
        rows, detections = self.whole.corners, self.whole.detections
        # Corners of boxes tell little of it, and would hide that of outlines; the centre of a box counts.
        # Among those that came since detections were judged are some that show something else.
        out = (self.given_up | self.unjudged)[rows.detection]
        used = detections.have(~out & (rows.loose_px == 0))
        noise = detections.mean(self._sigma_of(rows).square()[:, None])[:, 0] / detections.count
        of_each, share = told_apart(innovation, noise, used)
        found = lasting_errors(detections, rows, of_corners, noise, used, of_each)
        # Of sizes it is told once, of a fit that has come to rest: where they count for less, their errors show what else is
        # wrong.
        is_told = (self.lasting[1] > 0) | (self.judged == 0)
        # Errors that are larger than they are taken to be are so until the scales have found them.
        return before.toward(found, share.clamp_max(1.0), noise.mean(), is_told)
