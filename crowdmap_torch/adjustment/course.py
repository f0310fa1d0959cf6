"""What the way that a car takes says of its poses' errors: wheels roll where they point (`road.nonholonomic`).

Positions that slide sideways are wrong, or the headings are. In fits of one drive this holds the drift from knot to knot;
here it does from stretch to stretch of the bundle's drift. How the camera stands in the car, the angle from its axis to the
car's and the lever by which it swings out in bends, is the same all along a drive, and an unknown of it: `stance`.

Where a long drive is cut, the parting from the node before to the one behind is split in two: what the drift before adds,
less a number that the cut has behind its state, and this number with what the drift behind adds, each with half of the
variance. The number takes the middle, and what is left is the parting as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.config import CourseConfig
from crowdmap_torch.adjustment.observations import frame_offsets
from crowdmap_torch.noise.drift_nodes import DriftNodes
from crowdmap_torch.noise.pose_prior import PosePrior
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.processes.threads import in_order
from crowdmap_torch.residuals import pose as residuals
from crowdmap_torch.road.ego_motion import motion_of
from crowdmap_torch.road.nonholonomic import partings
from crowdmap_torch.tables import Journey

_UNBOUND_M = 1e3
"""1-sigma of the parting where none is asked for."""
_SUREST_M = 1e-3
"""Least 1-sigma of it: of a car that hardly moves, by poses that are said to have no noise, there would be none."""
_LEAST = 1e-9
"""Weight that is left to a parting that says nothing: where it is at a cut, nothing else holds the number there."""


@dataclass(frozen=True)
class Course:
    """How far the measured and the reckoned path of drives part sideways, from one node of their drift to the next."""

    before: Int[Tensor, " n"]
    """The first node of each two, in order."""
    cut: Int[Tensor, " n"]
    """The cut between them; -1: there is none."""
    journey: Int[Tensor, " n"]
    seen: Float[Tensor, " n"]
    of_before: Float[Tensor, "n 6"]
    of_after: Float[Tensor, "n 6"]
    of_stance: Float[Tensor, "n 2"]
    frames: Float[Tensor, " n"]
    variance: Float[Tensor, " n"]
    """As `Partings` have them."""
    journeys: Int[Tensor, " j"]
    """Those whose stances are held."""
    config: CourseConfig

    def of_nodes(self, first: int, last: int, journeys: Int[Tensor, " j"]) -> Course:
        """That of journeys with the nodes from the `first` to the one before the `last`, which are counted from there."""
        begin, end = torch.searchsorted(self.before, self.before.new_tensor([first, last])).tolist()
        rows = {f.name: getattr(self, f.name)[begin:end] for f in fields(self)[:-2]}
        rows["before"] = rows["before"] - first
        return replace(self, **rows, journeys=journeys)

    def at_cuts(
        self, drift: Float[Tensor, "n k"], stance: Float[Tensor, "j 2"]
    ) -> Float[Tensor, "s 1"]:
        """The number that each cut has of the parting there: half of what both sides are apart."""
        of = self.cut >= 0
        before, behind = drift[self.before[of], :6], drift[self.before[of] + 1, :6]
        known = (self.of_stance[of] * stance[self.journey[of]]).sum(1) + self.seen[of]
        known += (self.of_before[of] * before).sum(1)
        return ((known - (self.of_after[of] * behind).sum(1)) / 2)[:, None]

    def terms(
        self, white_sigma: Float[Tensor, " 6"], white_scale: Float[Tensor, "j 6"]
    ) -> dict[str, CostTerm]:
        """What binds the drift of neighbours, and what is usual of stances; by the noise of poses from frame to frame."""
        white = (white_sigma * white_scale)[:, :2].square().mean(1)
        variance = white[self.journey] * self.frames + self.variance
        weight = 1 / variance.sqrt().clamp_min(_SUREST_M)
        usual = weight.new_tensor((self.config.slip_sigma_rad, self.config.lever_sigma_m))
        nothing = torch.zeros_like(usual).expand(len(self.journeys), 2)
        inner, at_cut = self._rows
        bound, before_cut, behind_cut = self._slots
        found = {
            "course": CostTerm(
                residuals.parting_of_course,
                bound,
                (*(x[inner] for x in (self.seen, self.of_before, self.of_after, self.of_stance)),),
                weight=weight[inner],
                loss=Tukey(self.config.tukey_c, _LEAST),
                jacobian=residuals.parting_of_course_jacobian,
            ),
            "stance": CostTerm(
                residuals.gauss_markov_start,
                (("stance", self.journeys),),
                (nothing,),
                1 / usual.expand_as(nothing),
                takes_rows=True,
            ),
        }
        if len(at_cut):
            # Two losses of half the parting are the loss of the whole.
            half, loss = 2**0.5 * weight[at_cut], Tukey(self.config.tukey_c / 2**0.5, _LEAST)
            found["course_before_cut"] = CostTerm(
                residuals.parting_before_cut,
                before_cut,
                (self.seen[at_cut], self.of_before[at_cut], self.of_stance[at_cut]),
                *(half, loss, residuals.parting_before_cut_jacobian),
            )
            found["course_behind_cut"] = CostTerm(
                residuals.parting_behind_cut,
                behind_cut,
                (self.of_after[at_cut],),
                *(half, loss, residuals.parting_behind_cut_jacobian),
            )
        return found

    @cached_property
    def _rows(self) -> tuple[Int[Tensor, " i"], Int[Tensor, " c"]]:
        """Rows of neighbours that no cut is between, and of those with one."""
        none, some = torch.nonzero(self.cut < 0), torch.nonzero(self.cut >= 0)
        return none[:, 0], some[:, 0]

    @cached_property
    def _slots(self) -> tuple[tuple[tuple[str, Tensor], ...], ...]:
        """What is bound to each other where no cut is, before cuts and behind them; the same indices at every step."""
        inner, at_cut = self._rows
        drift, stance = ("drift", self.before[inner]), ("stance", self.journey[inner])
        before, cut = ("drift", self.before[at_cut]), ("cut", self.cut[at_cut])
        return (
            (drift, ("drift", drift[1] + 1), stance),
            (before, cut, ("stance", self.journey[at_cut])),
            (cut, ("drift", before[1] + 1)),
        )


def course_of(
    journeys: Sequence[Journey],
    frame: Int[Tensor, " p"],
    nodes: DriftNodes,
    cut: Int[Tensor, " s"],
    config: CourseConfig,
) -> Course:
    """Of journeys of which these frames, counted over all of them, have poses in a bundle; `cut` before these nodes."""
    offsets = frame_offsets(journeys)
    ends = torch.searchsorted(frame, frame.new_tensor(offsets)).tolist()
    number = torch.full_like(nodes.journey, -1)
    number[cut - 1] = torch.arange(len(cut), device=cut.device)

    def of_journey(own: int) -> tuple[Tensor, ...]:
        journey, here = journeys[own], slice(ends[own], ends[own + 1])
        of_node = nodes.of_frame[here]
        stretch = torch.full_like(journey.t_ns, -1)
        first, count = (int(of_node[0]), int(of_node[-1]) + 1) if len(of_node) else (0, 0)
        stretch[frame[here] - offsets[own]] = of_node - first
        found = partings(motion_of(journey), stretch, count - first, config.nonholonomic)
        before = found.before + first
        near = nodes.way[before + 1] - nodes.way[before] < config.reach_m
        # What a cut has of it is asked for wherever one is; nothing binds those that are far apart.
        near, far = near | (number[before] >= 0), ~near
        rows = (
            *(before, number[before], torch.full_like(before, own), found.seen * ~far),
            *(found.by_before[:, :6], found.by_after[:, :6]),
            *(found.by_before[:, 6:] + found.by_after[:, 6:], found.frames),
            torch.where(far, _UNBOUND_M**2, found.variance),
        )
        return tuple(row[near] for row in rows)

    every = in_order(of_journey, range(len(journeys)), frame.device)
    rows = (torch.cat(of_all) for of_all in zip(*every, strict=True))
    return Course(*rows, journeys=torch.arange(len(journeys), device=frame.device), config=config)


def states_at_cuts(
    prior: PosePrior,
    course: Course | None,
    drift: Float[Tensor, "n k"],
    stance: Float[Tensor, "_ 2"],
) -> Float[Tensor, "s _"]:
    """Where what is unknown at cuts may begin."""
    state = prior.at_cuts(drift)
    return state if course is None else torch.cat((state, course.at_cuts(drift, stance)), dim=1)
