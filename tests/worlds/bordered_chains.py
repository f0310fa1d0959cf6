"""Drives whose errors are chains about a bias of their own, as a small problem of `optim`."""

from __future__ import annotations

import torch

from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.plan import EliminationPlan

KEEP = 0.9


def step_without_bias(before, after, bias):
    return (after - bias) - KEEP * (before - bias)


def sighting(pose, mark, measured):
    """Bends, so that the normal equations differ from point to point."""
    offset = mark - pose
    return offset + 0.01 * offset.square() - measured


def drives(lengths=(30, 1, 17), marks=7, seed=0):
    """Poses on drifting chains, each chain with a bias of its own; the last bias has no chain."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    chain = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    n, biases = len(chain), len(lengths) + 1
    way = torch.cat([torch.linspace(0, 10, length) for length in lengths]).double()
    # Two poses hang on every block of the chain.
    carrier = torch.arange(n).repeat_interleave(2)
    place = torch.linspace(0, 10, marks).double()
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
    plan = EliminationPlan("drift", chain, "pose", carrier, "bias")
    return Problem(variables, terms), values, plan


def rows_of(dense, name):
    """Rows of a variable's tangents in the dense system."""
    at = dense.where.offset[name][:, None]
    return (at + torch.arange(dense.where.tangent_dim[name])).flatten()
