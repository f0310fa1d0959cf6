"""Bundle adjustment shared out: drives in convoys, wherever an engine has hosts for them, the map with their leader.

A convoy is some successive drives with their poses and observations, and a copy of all that is unknown of the map and of
the border. Each takes the steps of the one adjustment, in time with the others: they meet where sums over all drives are
needed, costs, products, the reduced systems (`optim.solvers.journey_system`), and where scales are found of everybody's
residuals. Between two steps the bundle that was shared out has everything: from it a convoy that was lost begins anew.

How many convoys there are depends on the way that was driven alone, and sums are taken in their order: the map has the same
bits on any engine with any number of workers.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment.bias_sums import sums_of_bias
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import Fleet
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.parts import Observations, Priors, SharedOut, Unknowns
from crowdmap_torch.adjustment.residual_summary import TermSummary, joined, residual_summary
from crowdmap_torch.adjustment.steps import adjust_step
from crowdmap_torch.fleet.company import Company, Program
from crowdmap_torch.fleet.engine import Engine
from crowdmap_torch.fleet.here import InProcess
from crowdmap_torch.optim.levenberg_marquardt import LmState
from crowdmap_torch.optim.problem import Problem
from crowdmap_torch.optim.solvers.journey_system import JourneyBackend, JourneyEquations, MapSystem
from crowdmap_torch.optim.solvers.normal_equations import MapCovariance
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.processes.memory import give_back
from crowdmap_torch.processes.records import alone
from crowdmap_torch.processes.together import Member, Together

_OWN = ("pose", "drift")
"""The unknowns that each convoy has of its own drives alone."""
_ROWS = ("match_t", "match_normal", "match_valid", "poses_left", "held_off", "innovation")
"""What a bundle keeps of each lane point, of each pose, and of each detection of a sign."""


@dataclass(frozen=True)
class Convoy:
    """Some successive drives of a bundle, between two steps of its adjustment: all that goes to where their work is done."""

    unknowns: Unknowns
    observations: Observations
    priors: Priors
    config: AdjustConfig
    plan: EliminationPlan
    kept: dict[str, Tensor]
    """What the bundle keeps beside its unknowns, by name."""
    state: LmState | None
    """None: no step is to be taken."""

    def bundle(self, together: Together, whole: Bundle | None = None) -> Bundle:
        """Their bundle, which works with others `together`; with their leader's is the `whole`."""
        shared_out = SharedOut(together, self.plan, len(self.kept["given_up"]))
        own = self.unknowns, self.observations, self.priors, self.config
        bundle = Bundle(*own, shared_out, whole)
        bundle.load_state_dict({**bundle.state_dict(), **self.kept})
        return bundle


@torch.no_grad()
def convoy(bundle: Bundle, state: LmState | None, first: int, last: int) -> Convoy:
    """The journeys of a bundle from the `first` to the one before the `last`, where its adjustment stands."""
    nodes, values = bundle.prior.nodes, bundle.values()
    ends = nodes.journey.new_tensor([first, last])
    of_nodes = slice(*torch.searchsorted(nodes.journey.contiguous(), ends).tolist())
    ends = ends.new_tensor([of_nodes.start, of_nodes.stop])
    of_poses = slice(*torch.searchsorted(nodes.of_frame.contiguous(), ends).tolist())
    own = {"pose": of_poses, "drift": of_nodes}
    here = torch.arange(len(bundle.prior_scale), device=ends.device)
    here = (here >= first) & (here < last)
    corner, point = here[bundle.corners.journey], here[bundle.lane_points.journey]
    corners, points = bundle.corners[corner], bundle.lane_points[point]
    beside = bundle.beside - of_poses.start
    is_here = (beside >= 0) & (bundle.beside < of_poses.stop)
    prior = bundle.prior.of_journeys(first, last)
    kept = {k: v for k, v in bundle.state_dict().items() if k not in bundle.unknown_names}
    of_sign = corner[bundle.detections.first]
    rows = dict.fromkeys(_ROWS, point) | {"poses_left": of_poses}
    rows |= dict.fromkeys(("held_off", "innovation"), of_sign)
    kept |= {name: kept[name][of] for name, of in rows.items()}

    def of_all(name: str, value: Tensor) -> Tensor:
        return value[own[name]] if name in own else value

    return Convoy(
        unknowns=Unknowns(
            {name: of_all(name, value) for name, value in values.items()},
            *(bundle.frame[of_poses], bundle.lane_count),
        ),
        observations=Observations(
            replace(corners, frame=corners.frame - of_poses.start),
            replace(points, frame=points.frame - of_poses.start),
            *(bundle.begun_matches[point], bundle.lenses),
        ),
        priors=Priors(
            prior,
            bundle.fixed,
            torch.where(is_here, beside, -1),
            _of_poses(bundle.fleet, of_poses),
            bundle.course and bundle.course.of_nodes(of_nodes.start, of_nodes.stop, prior.journeys),
        ),
        config=bundle.config,
        plan=_plan(bundle, of_nodes, of_poses),
        kept=kept,
        state=state
        and replace(
            state,
            values={name: of_all(name, value) for name, value in state.values.items()},
            normal=None,
        ),
    )


def _of_poses(fleet: Fleet, poses: slice) -> Fleet:
    return replace(
        fleet,
        of_pose=fleet.of_pose[poses],
        velocity=fleet.velocity[poses],
        turning=fleet.turning[poses],
    )


def _plan(bundle: Bundle, nodes: slice, poses: slice) -> EliminationPlan:
    """What is eliminated of some poses and nodes; a leader has none."""
    plan = bundle.plan
    assert plan.carrier is not None and plan.joint is not None
    chain = plan.chain[nodes]
    first, end = (int(chain[0]), int(chain[-1]) + 1) if len(chain) else (0, 0)
    leaves, count = poses.stop - poses.start, nodes.stop - nodes.start
    room = plan.room
    if room is not None:
        # Keys count leaves, then nodes, each with all landmarks.
        own = {*_OWN, *plan.border}
        landmarks = sum(len(of) for name, of in bundle.values().items() if name not in own)
        block, landmark = room // landmarks, room % landmarks
        leaf, node = block - poses.start, block - plan.leaf_count - nodes.start
        is_leaf = (leaf >= 0) & (leaf < leaves) & (block < plan.leaf_count)
        is_node = (node >= 0) & (node < count)
        block = torch.where(is_leaf, leaf, node + leaves)
        room = (block * landmarks + landmark)[is_leaf | is_node]
    part = plan.part
    if part is not None:
        _, part = torch.unique(part[first:end], return_inverse=True)
    return replace(
        plan,
        chain=chain - first,
        carrier=plan.carrier[poses] - nodes.start,
        border={name: block[first:end] for name, block in plan.border.items()},
        joint=plan.joint[first:end],
        room=room,
        part=part,
        is_whole=False,
    )


# ---- the program of a convoy ----


def drive_along(member: Member) -> None:
    """What a convoy does: steps in time with the others, and its part of covariances, until it is ended."""
    own: Convoy = member.take()
    bundle, state = own.bundle(member), own.state
    # The bundle has all that is worth keeping.
    del own
    give_back()
    while True:
        asked, *of = member.told()
        if asked == "step":
            assert state is not None
            state, _ = adjust_step(bundle, state, bundle.backend())
            give_back()
            moved = bool(state.accepted.all())
            member.for_leader(list, _moved(bundle) if moved else ())
        elif asked == "residuals":
            member.for_leader(list, residual_summary(bundle))
        elif asked == "systems":
            _equations(bundle, bundle.problem()).systems()
        else:
            equations = _equations(bundle, bundle.information(*of))
            equations.share_covariance()
            equations.sums_of_chains(*sums_of_bias(bundle))


@torch.no_grad()
def _moved(bundle: Bundle) -> tuple[Tensor, ...]:
    """What a step changes of what is a convoy's own."""
    values, kept = bundle.values(), bundle.state_dict()
    return (*(values[name] for name in _OWN), *(kept[name] for name in _ROWS))


@torch.no_grad()
def _equations(bundle: Bundle, problem: Problem) -> JourneyEquations:
    """Those of a problem of the bundle where it stands."""
    backend = bundle.backend()
    assert isinstance(backend, JourneyBackend)
    return backend.assemble(problem, bundle.values())


# ---- their leader ----


class Convoys(ExitStack):
    """The convoys of a bundle on the hosts of an engine, a context manager that ends them; and their leader's part."""

    def __init__(
        self,
        bundle: Bundle,
        state: LmState | None,
        engine: Engine | None = None,
        parts: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        """`bundle` stands where `state` does, and follows step by step; without one no step may be taken.

        `parts` are the first journey of each convoy and the one behind its last; None: the bundle's convoys.
        """
        super().__init__()
        self.bundle, self.state = bundle, state
        self._parts = bundle.convoys if parts is None else parts
        engine = InProcess() if engine is None else engine
        # Behind the company's end: its hosts are gone by then.
        self.push(self._ended)
        self._company = self.enter_context(
            Company(engine, len(self._parts), self._program, "bundle adjustment")
        )
        self._leader = self._company.leader
        own = convoy(bundle, state, 0, 0)
        self._own, self._state = own.bundle(self._leader, bundle), own.state
        # Convoys were copied to be handed over, and have what follows from their observations.
        bundle.rest()
        give_back()

    def _ended(self, kind: type[BaseException] | None, *_: object) -> None:
        """Has the lenses of the bundle follow, unless all ends in an error.

        What is as large as the map goes at once: what refers to itself in a circle stays until somebody looks.
        """
        self._own.forget_factors()
        self._state = self._state and replace(self._state, normal=None)
        if kind is None or issubclass(kind, GeneratorExit):
            self.bundle.relinearise()
        del self._own, self._company, self._leader, self.bundle

    def _program(self, number: int) -> Program:
        return drive_along, alone(convoy(self.bundle, self.state, *self._parts[number]))

    @torch.no_grad()
    def step(self) -> tuple[LmState, bool]:
        """`adjust_step` of the bundle."""
        assert self._state is not None
        self._leader.tell(("step",))
        self._state, finished = adjust_step(self._own, self._state, self._own.backend())
        found = self._leader.for_leader(list, ())
        self._company.renew(lambda: self._follow([part for part in found if part]))
        give_back()
        assert self.state is not None
        return self.state, finished

    def residuals(self) -> dict[str, TermSummary]:
        """`residual_summary` of the bundle."""
        self._leader.tell(("residuals",))
        found = self._leader.for_leader(joined, residual_summary(self._own))
        assert found is not None, "of the leader"
        return found

    def covariance(
        self, prior_scale: Float[Tensor, "j _"]
    ) -> tuple[MapCovariance, Float[Tensor, "j 4 4"]]:
        """The covariance of what stays, with sigmas of that scale, and that of the journeys' biases."""
        self._leader.tell(("covariance", prior_scale))
        equations = _equations(self._own, self._own.information(prior_scale))
        covariance = equations.covariance()
        return covariance, covariance.of_sums(*sums_of_bias(self._own))

    def systems(self) -> MapSystem:
        """What each convoy says of the map where the bundle stands."""
        self._leader.tell(("systems",))
        found = _equations(self._own, self._own.problem()).systems()
        assert found is not None, "of the leader"
        return found

    def _follow(self, moved: list[tuple[Tensor, ...]]) -> None:
        """Has the bundle where the convoys are; `moved` is what each has of its own, nothing where no step was taken.

        But for its lenses, until the end: a convoy that begins anew takes its own.
        """
        assert self._state is not None and self.state is not None
        bundle, values = self.bundle, dict(self._state.values)
        values |= {name: self.state.values[name] for name in _OWN}
        if moved:
            every = [torch.cat(each) for each in zip(*moved, strict=True)]
            found = dict(zip((*_OWN, *_ROWS), every, strict=True))
            values |= {name: found[name] for name in _OWN}
            kept = {**self._own.state_dict(), **found}
            for name in kept.keys() - bundle.unknown_names - {*_OWN}:
                getattr(bundle, name).copy_(kept[name])
            bundle.fold(values)
        self.state = replace(self._state, values=values, normal=None)
