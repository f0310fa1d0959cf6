"""Diagonal blocks of the inverse of chains, with and without leaves, beside the dense inverse."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.solvers import selected_inverse
from crowdmap_torch.optim.solvers.elimination import ChainStructure, analyse
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.selected_inverse import diagonal_of_inverse

K = 2


def structure(lengths: list[int], carrier: Tensor | None) -> ChainStructure:
    """That of chains whose neighbours are linked, and of leaves on them."""
    chain = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    follows = torch.nonzero(chain[1:] == chain[:-1])[:, 0]
    variables = {"node": Variable(K, euclidean)}
    values = {"node": torch.zeros(len(chain), K, dtype=torch.float64)}
    slots = (("node", follows), ("node", follows + 1))
    terms = {"link": CostTerm(lambda a, b: a - b, slots)}
    if carrier is None:
        plan = EliminationPlan(chains="node", chain=chain)
    else:
        variables["leaf"] = Variable(K, euclidean)
        values["leaf"] = torch.zeros(len(carrier), K, dtype=torch.float64)
        at = torch.arange(len(carrier))
        terms["carried"] = CostTerm(lambda a, b: a - b, (("leaf", at), ("node", carrier)))
        plan = EliminationPlan(chains="node", chain=chain, leaves="leaf", carrier=carrier)
    return analyse(Problem(variables, terms), values, plan, group_size=None, batch_bytes=1 << 20)


@pytest.mark.parametrize("lengths", [[1], [2], [5, 1, 8], [33]])
@pytest.mark.parametrize("leaves", [0, 7])
@pytest.mark.parametrize("lot", [2, 1 << 12])
def test_blocks_are_those_of_the_dense_inverse(
    lengths: list[int], leaves: int, lot: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(selected_inverse, "_AT_ONCE", lot)
    generator = torch.Generator().manual_seed(sum(lengths))
    nodes = sum(lengths)
    chain = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    carrier = torch.randint(nodes, (leaves,), generator=generator).sort().values
    n = leaves + nodes
    link = torch.randn(n, K, K, dtype=torch.float64, generator=generator)
    whole = torch.zeros(n, K, n, K, dtype=torch.float64)
    partner = [leaves + int(c) for c in carrier] + [
        leaves + i + 1 if i + 1 < nodes and chain[i] == chain[i + 1] else -1 for i in range(nodes)
    ]
    for i, j in enumerate(partner):
        if j < 0:
            link[i] = 0
        else:
            whole[i, :, j], whole[j, :, i] = link[i], link[i].T
    diagonal = 20.0 * torch.eye(K).double() + torch.rand(n, 1, 1, generator=generator).double()
    for i in range(n):
        whole[i, :, i] = diagonal[i]
    inverse = torch.linalg.inv(whole.view(n * K, n * K)).view(n, K, n, K)
    expected = torch.stack([inverse[i, :, i] for i in range(n)])
    (part,) = structure(lengths, carrier if leaves else None).parts
    found = diagonal_of_inverse(part, part.leads(diagonal, link))
    assert torch.allclose(found, expected, atol=1e-12)
    found = diagonal_of_inverse(part, part.leads(diagonal, link), leaves=False)
    assert torch.allclose(found, expected[leaves:], atol=1e-12)
