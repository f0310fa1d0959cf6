"""Drives whose errors are chains about a bias of their own, as a small problem of `optim`."""

from __future__ import annotations

from dataclasses import replace

import torch

from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.plan import EliminationPlan

KEEP = 0.9


def step_without_bias(before, after, bias):
    return (after - bias) - KEEP * (before - bias)


def sighting(pose, mark, measured):
    """Bends, so that the normal equations differ from point to point."""
    offset = mark - pose
    return offset + 0.01 * offset.square() - measured


def drives(lengths=(30, 1, 17), marks=7, seed=0, *, apart=0.0):
    """Poses on drifting chains, each chain with a bias of its own; the last bias has no chain.

    Each drive begins so far behind the one before, and marks are spread over all of the way.
    """
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    chain = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    n, biases = len(chain), len(lengths) + 1
    way = torch.cat([torch.linspace(0, 10, length) for length in lengths]).double()
    way = way + apart * chain
    # Two poses hang on every block of the chain.
    carrier = torch.arange(n).repeat_interleave(2)
    place = torch.linspace(0, 10 + apart * (len(lengths) - 1), marks).double()
    pose, mark = torch.nonzero((way[carrier][:, None] - place).abs() < 4, as_tuple=True)
    follows = torch.nonzero(chain[1:] == chain[:-1])[:, 0]
    first = torch.cat((chain[:1] >= 0, chain[1:] != chain[:-1])).nonzero()[:, 0]
    terms = {
        "start": CostTerm(lambda d, b: d - b, (("drift", first), ("bias", chain[first]))),
        "step": CostTerm(
            step_without_bias,
            (("drift", follows), ("drift", follows + 1), ("bias", chain[follows])),
            weight=torch.full((len(follows),), 3.0).double(),
        ),
        "bias": CostTerm(
            lambda b: b,
            (("bias", torch.arange(biases)),),
            weight=torch.full((biases,), 0.7).double(),
        ),
        "bound": CostTerm(lambda x, d: x - d, (("pose", torch.arange(2 * n)), ("drift", carrier))),
        "sighting": CostTerm(
            sighting, (("pose", pose), ("mark", mark)), (noise(len(pose), 2),), None
        ),
    }
    names = {"pose": 2 * n, "drift": n, "bias": biases, "mark": marks}
    variables = {name: Variable(2, euclidean) for name in names}
    values = {name: noise(count, 2) for name, count in names.items()}
    border = {"bias": torch.arange(len(lengths))}
    plan = EliminationPlan("drift", chain, "pose", carrier, border)
    return Problem(variables, terms), values, plan


def shared_drives(lengths=(30, 1, 17), marks=7, seed=0):
    """The same by cars with errors of their own, of three numbers: in every pose, in every sighting, and beside the bias.

    Chains take turns with two cars; a third has no chain.
    """
    problem, values, plan = drives(lengths, marks, seed)
    car = torch.arange(len(lengths) + 1) % 2
    of_drift, of_pose = car[plan.chain], car[plan.chain][plan.carrier]
    sighting = problem.terms["sighting"]
    pose = sighting.slots[0][1]
    every = torch.arange(3)

    def bound(x, d, c):
        return x - d - c[:2]

    def seen(x, m, c, measured):
        return (m - x) * (1 + 0.1 * c[2]) + 0.3 * c[1:] - measured

    def beside(d, b, c):
        return d - b + c[:2] * c[2]

    first = problem.terms["start"].slots[0][1]
    terms = {
        **problem.terms,
        "bound": replace(
            problem.terms["bound"],
            residual=bound,
            slots=(*problem.terms["bound"].slots, ("car", of_pose)),
        ),
        "sighting": CostTerm(
            seen, (("pose", pose), sighting.slots[1], ("car", of_pose[pose])), sighting.constants
        ),
        "start": CostTerm(beside, (*problem.terms["start"].slots, ("car", of_drift[first]))),
        "car": CostTerm(lambda c: c - 0.3, (("car", every),)),
        "mark of a car": CostTerm(
            lambda c, m: c[:2] - m,
            (("car", every), ("mark", every)),
            weight=torch.full((3,), 0.2).double(),
        ),
    }
    generator = torch.Generator().manual_seed(seed + 1)
    variables = {**problem.variables, "car": Variable(3, euclidean)}
    values = {**values, "car": torch.randn(3, 3, dtype=torch.float64, generator=generator)}
    return Problem(variables, terms), values, replace(plan, border={**plan.border, "car": car[:-1]})


def wandering_drives(lengths=(30, 1, 17), marks=7, seed=0):
    """`drives` whose chains have a third number, by which what they are drawn to wanders: wider than the poses."""
    problem, values, plan = drives(lengths, marks, seed)
    terms = problem.terms

    def start(d, b):
        return torch.cat((d[:2] - d[2:] - b, d[2:]))

    def step(before, after, b):
        return start(after, b) - KEEP * start(before, b)

    terms = {
        **terms,
        "start": replace(terms["start"], residual=start),
        "step": replace(terms["step"], residual=step),
        "bound": replace(terms["bound"], residual=lambda x, d: x - d[:2]),
    }
    generator = torch.Generator().manual_seed(seed + 2)
    drift = torch.randn(len(plan.chain), 3, dtype=torch.float64, generator=generator)
    variables = {**problem.variables, "drift": Variable(3, euclidean)}
    return Problem(variables, terms), {**values, "drift": drift}, plan


def rows_of(dense, name):
    """Rows of a variable's tangents in the dense system."""
    at = dense.where.offset[name][:, None]
    return (at + torch.arange(dense.where.tangent_dim[name])).flatten()


def assert_the_last_factors_serve_another_gradient(problem, values, plan):
    """The step of the gradient itself is that of the solve, and that of any other one the dense one."""
    ours = ChainBackend(plan).assemble(problem, values)
    dense = DenseBackend().assemble(problem, values)
    damping = torch.tensor([1e-3], dtype=torch.float64)
    step = ours.solve(damping)
    for name, own in ours.correct(ours.tangent_gradient).delta.items():
        torch.testing.assert_close(own, step.delta[name], rtol=1e-9, atol=1e-12)
    other = {name: torch.cos(3 * x + 1) for name, x in ours.tangent_gradient.items()}
    asked = replace(dense, gradient=dense.where.pack(other)).solve(damping).delta
    for name, own in ours.correct(other).delta.items():
        torch.testing.assert_close(own, asked[name], rtol=1e-8, atol=1e-10)
