"""The steps of bundle adjustment: where it starts, and one step, folded into the bundle (V-B)."""

from __future__ import annotations

from dataclasses import replace

import torch

from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.normal_equations import MapBackend, MapEquations
from crowdmap_torch.processes.memory import give_back
from crowdmap_torch.processes.threads import one_core_each

_NEAR = 2.0
"""Scales of a few drives move nothing where all steps to come take landmarks no further than the last one may, by this
factor: the map rests on the other drives."""


@one_core_each()
@torch.no_grad()
def start(bundle: Bundle) -> lm.LmState:
    """The state before the first step: lanes matched, scales as wide as residuals show, the order of elimination found.

    Of many drives the convoys find their own.
    """
    bundle.fold(bundle.values())
    bundle.refresh(waits=bool(bundle.unjudged.any()))
    problem, values = bundle.problem(), bundle.values()
    backend = bundle.backend()
    if isinstance(backend, ChainBackend) and len(bundle.convoys) == 1:
        backend.prepare(problem, values)
    give_back()
    return lm.init(problem, values, bundle.config.lm)


@one_core_each()
@torch.no_grad()
def adjust_step(bundle: Bundle, state: lm.LmState, backend: MapBackend) -> tuple[lm.LmState, bool]:
    """One step of the solver, folded into the bundle, and whether the adjustment is finished.

    Lanes are matched anew and the scales narrowed after every step that was taken; detections are judged when the scales
    that they are judged by first come to rest, and when the solver stops. Those that came in since are judged after two
    steps, by the noise that is known: what is wrong among them would have that grow step by step. It is finished when
    judging changes nothing, or no more than is lost in how little is known.
    """
    problem, first = bundle.problem(), int(bundle.judged) == 0
    bundle.steps_judged += not first
    normal = state.normal
    if not isinstance(normal, MapEquations):
        normal = backend.assemble(problem, state.values)
        state = replace(state, normal=normal, linearizations=state.linearizations + 1)
        # What was added up leaves room between what is kept, where it went to.
        give_back()
    state = lm.step(problem, state, bundle.config.lm, backend=backend)
    corners = problem.terms.get("sign_reprojection")
    # As large as what the lenses are taken anew in.
    del problem
    if not bool(state.accepted.all()) and not state.done:
        return state, False
    waits = bool(bundle.unjudged.any())
    evidence = None if waits else bundle.evidence() or bundle.told_by(normal, corners)
    del corners
    follows = bool(bundle.fleet.kinds) and not waits
    of_border = normal.border_information() if follows else None
    bundle.fold(dict(state.values))
    found = bundle.refresh(evidence, of_border, waits=waits)
    # Scales that no longer move anything are at rest, however much they still change: little is known of them.
    # One short step does not tell: it may be the last before other detections count.
    moves = torch.maximum(state.in_sigmas_before, state.in_sigmas_left)
    near = bundle.config.lm.move_tolerance * (_NEAR if found.judging else 1.0)
    settled = state.done and bool((moves < near).all())
    at_rest = found.scales or settled
    # What came in has a step to go where it is seen, and one that tells where that is.
    soon = found.judging and not (waits and bool(state.in_sigmas_before.isinf().any()))
    is_time = (soon or settled) if first or waits else (at_rest and state.done)
    if is_time and bundle.judge(normal):
        if state.done:
            state = lm.settled(bundle.problem(), state, normal, bundle.config.lm)
        at_rest &= state.done
        if at_rest:
            bundle.fold(dict(state.values))
            at_rest = bundle.refresh(evidence).scales or settled
    if state.done and at_rest and not waits:
        return state, True
    return lm.changed(state), False
