"""Drives whose errors are chains about a bias of their own, as a small problem of `optim`."""

from __future__ import annotations

import torch

from crowdmap_torch.optim.border import BorderedBackend
from crowdmap_torch.optim.chain import ChainBackend
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean

KEEP = 0.9


def step_without_bias(before, after, bias):
    return (after - bias) - KEEP * (before - bias)


def step_jacobian(before, after, bias):
    eye = torch.eye(2, dtype=before.dtype).expand(len(before), 2, 2)
    return step_without_bias(before, after, bias), (-KEEP * eye, eye, (KEEP - 1) * eye)


def start_jacobian(first, bias):
    eye = torch.eye(2, dtype=first.dtype).expand(len(first), 2, 2)
    return first - bias, (eye, -eye)


def prior_jacobian(bias):
    return bias, (torch.eye(2, dtype=bias.dtype).expand(len(bias), 2, 2),)


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
        "start": CostTerm(
            lambda d, b: d - b, (("drift", first), ("bias", chain[first])), jacobian=start_jacobian
        ),
        "step": CostTerm(
            step_without_bias,
            (("drift", follows), ("drift", follows + 1), ("bias", chain[follows])),
            weight=torch.full((len(follows),), 3.0).double(),
            jacobian=step_jacobian,
        ),
        "bias": CostTerm(
            lambda b: b,
            (("bias", torch.arange(biases)),),
            weight=torch.full((biases,), 0.7).double(),
            jacobian=prior_jacobian,
        ),
        "bound": CostTerm(lambda x, d: x - d, (("pose", torch.arange(2 * n)), ("drift", carrier))),
        "sighting": CostTerm(
            sighting, (("pose", pose), ("mark", mark)), (noise(len(pose), 2),), None
        ),
    }
    names = {"pose": 2 * n, "drift": n, "bias": biases, "mark": marks}
    variables = {name: Variable(2, euclidean) for name in names}
    values = {name: noise(count, 2) for name, count in names.items()}
    backend = BorderedBackend(ChainBackend("drift", chain, leaves="pose", carrier=carrier), "bias")
    return Problem(variables, terms), values, backend, chain


def rows_of(dense, name):
    """Rows of a variable's tangents in the dense system."""
    at = dense.where.offset[name][:, None]
    return (at + torch.arange(dense.where.tangent_dim[name])).flatten()
