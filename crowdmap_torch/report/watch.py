"""What is watched while bundle adjustment runs: costs, residuals, errors against the survey, the map."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import columns
from crowdmap_torch.adjustment.residual_summary import TermSummary, residual_summary
from crowdmap_torch.evaluation.evaluate import Against, progress_scalars
from crowdmap_torch.optim.levenberg_marquardt import LmState
from crowdmap_torch.optim.linearize import residuals
from crowdmap_torch.report import plots
from crowdmap_torch.report.iteration import Iteration
from crowdmap_torch.report.tensorboard import TensorBoardLog
from crowdmap_torch.tables import HdMap, Lanes, Signs

_LANES_EVERY = 5
"""Lanes are compared with the survey every this many steps: it takes longer than a step."""

_MOST_CAMERAS = 4
"""Whose residuals are drawn: those that saw most."""
_MOST_CARS = 12
"""Whose calibration is followed."""


@dataclass(frozen=True)
class Residuals:
    """Lengths of pixel residuals before the first step, and the cost there."""

    by_stage: Mapping[str, Float[Tensor, " _"]]
    cost: float


@dataclass(frozen=True)
class Course:
    """The steps of an adjustment, as they were watched."""

    iterations: tuple[Iteration, ...]


class Watch:
    """Logs every step of the adjustment to TensorBoard, and keeps them for the report."""

    def __init__(
        self,
        log: TensorBoardLog,
        asked: Against | None,
        signs: Signs,
        lanes: Lanes,
        *,
        every: int = 1,
        min_confidence: float = 0.0,
    ) -> None:
        """`asked` is what errors are told of; signs below `min_confidence` are not of the map and have none."""
        self.iterations: list[Iteration] = []
        self.residual_px: dict[str, Float[Tensor, " n"]] = {}
        self._log = log
        self._asked = asked
        self._survey = None if asked is None else asked.survey
        self._cost = math.nan
        self._every = max(every, 1)
        self._least = min_confidence
        self.follow(signs, lanes)

    @torch.no_grad()
    def follow(self, signs: Signs, lanes: Lanes, begins: Bundle | None = None) -> None:
        """What bundles hold from now on; where the adjustment `begins` with another one, costs are told from there."""
        self._certain = signs.confidence >= self._least
        self._signs, self._lanes = signs, lanes
        if begins is not None:
            self._cost = _cost(residual_summary(begins))

    @torch.no_grad()
    def start(self, bundle: Bundle, map_before: HdMap) -> Residuals:
        """The map of the cluster heads and its residuals, before the first step."""
        self._log.log_map("map/before", map_before, self._survey, 0)
        self.residual_px["cluster heads"] = corner_residuals(bundle).norm(dim=-1)
        errors = self._errors(bundle, with_lanes=True)
        self._log.log_scalars(errors, 0)
        self._cost = _cost(residual_summary(bundle))
        return Residuals(self.residual_px, self._cost)

    @property
    def course(self) -> Course:
        """The steps up to now."""
        return Course(tuple(self.iterations))

    def go_on(self, residuals: Residuals, course: Course) -> None:
        """Takes over what another watch saw, up to where it was interrupted."""
        self.residual_px = dict(residuals.by_stage)
        self.iterations = list(course.iterations)
        self._cost = self.iterations[-1].cost_after if self.iterations else residuals.cost

    @torch.no_grad()
    def step(
        self, number: int, state: LmState, bundle: Bundle, summary: Mapping[str, TermSummary]
    ) -> None:
        """One step of the solver, and what it leaves of the residuals."""
        looked_at = number % self._every == 0
        before, self._cost = self._cost, _cost(summary)
        iteration = Iteration(
            number=number + 1,
            cost={name: float(cost) for name, cost in state.term_cost.items()},
            damping=float(state.damping),
            gain_ratio=float(state.gain_ratio),
            step_norm=float(state.step_norm),
            accepted=bool(state.accepted),
            cost_before=before,
            cost_after=self._cost,
            scale=_scales(bundle),
            judged=int(bundle.judged),
            errors=self._errors(bundle, with_lanes=number % _LANES_EVERY == 0) if looked_at else {},
        )
        self.iterations.append(iteration)
        if not looked_at:
            self._log.log_iteration(iteration)
            return
        for name, term in summary.items():
            self._log.log_histogram(f"residual/{name}", term.squared.sqrt(), number + 1)
            self._log.log_histogram(f"weight/{name}", term.weight, number + 1)
        down_weighted = {name: term.down_weighted_share for name, term in summary.items()}
        self._log.log_iteration(iteration, down_weighted=down_weighted)
        scales = {f"scale/{name}": value for name, value in iteration.scale.items()}
        self._log.log_scalars(scales, number + 1)
        self._log.log_scalars(dict(_calibration_scalars(bundle)), number + 1)
        if len(bundle.corners):
            given_up = bundle.given_up[bundle.corners.detection].double().mean()
            self._log.log_scalars({"robust/given_up": float(given_up)}, number + 1)

    @torch.no_grad()
    def finish(self, bundle: Bundle, hd_map: HdMap) -> None:
        """The adjusted map and its residuals."""
        steps = len(self.iterations)
        self._log.log_map("map/after", hd_map, self._survey, steps)
        residual = corner_residuals(bundle)
        self.residual_px["adjusted map"] = residual.norm(dim=-1)
        self._log.log_figure("residual/by_stage", plots.plot_residuals(self.residual_px), steps)
        camera = bundle.corners.lens.cpu()
        most = torch.bincount(camera, minlength=len(bundle.lenses)).argsort(descending=True)
        for number in most[:_MOST_CAMERAS].tolist():
            lens, of = bundle.lenses[number], camera == number
            figure = plots.plot_residuals_over_image(
                bundle.corners.px.cpu()[of], residual[of], (lens.width, lens.height)
            )
            self._log.log_figure(f"residual/over_image_{number}", figure, steps)

    def _errors(self, bundle: Bundle, *, with_lanes: bool) -> dict[str, float]:
        if self._asked is None or not len(self._signs):
            return {}
        signs, lanes = adjust.read_map(bundle, self._signs, self._lanes)
        return progress_scalars(
            signs[self._certain], self._asked, lanes=lanes if with_lanes else None
        )


def _cost(summary: Mapping[str, TermSummary]) -> float:
    """Of all terms."""
    return sum(term.cost for term in summary.values())


def _scales(bundle: Bundle) -> dict[str, float]:
    names = ("sign_px", "lane_px", "lane_correlation")
    scales = dict(zip(names, bundle.scale.tolist(), strict=True))
    lasting = {"lasting_px": bundle.lasting[0], "lasting_size": bundle.lasting[1]}
    return {**scales, **{name: math.sqrt(float(variance)) for name, variance in lasting.items()}}


def corner_residuals(bundle: Bundle) -> Float[Tensor, "m 2"]:
    """Every sign corner's reprojection error in u and v, on the CPU [px]."""
    term = bundle.problem().terms.get("sign_reprojection")
    if term is None or not len(term):
        return torch.zeros(0, 2, dtype=bundle.scale.dtype)
    term = replace(term, shared=None)
    return (residuals(term, bundle.values()) * bundle.corner_sigma()[:, None]).cpu()


def _calibration_scalars(bundle: Bundle) -> Iterator[tuple[str, float]]:
    """Tag and value of every number of the first cars, in the configuration's units."""
    values, fleet = bundle.values(), bundle.fleet
    for variable in fleet.variables:
        for name, at in columns(variable, fleet.config).items():
            numbers = values[variable][:_MOST_CARS, at].detach() * getattr(fleet.config, name)
            for car, row in zip(fleet.vehicles, numbers.tolist(), strict=False):
                for k, value in enumerate(row):
                    end = f"_{k}" if len(row) > 1 else ""
                    yield f"calibration/{name}{end}/{car}", value
