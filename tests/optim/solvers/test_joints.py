"""What joints add, held to the plain product; that whole adjustments are those of uncut drives is in test_chain_schur.py."""

from __future__ import annotations

import torch

from crowdmap_torch.optim.solvers.joints import Joints
from crowdmap_torch.optim.solvers.normal_equations import ChainChanges


def joined(chains: int, blocks: int, width: int = 2) -> Joints:
    """One drive of chains between joints, and as many blocks, chain by chain."""
    make = torch.Generator().manual_seed(7)
    size = (chains + 1) * width
    root = torch.randn(size, size, dtype=torch.double, generator=make)
    covariance = root @ root.T / size + torch.eye(size)
    first = torch.arange(chains)[:, None] * width
    return Joints(
        goes_with=torch.randn(blocks, 3, 2 * width, dtype=torch.double, generator=make),
        owner=torch.arange(blocks) * chains // blocks,
        drive=torch.zeros(chains, dtype=torch.long),
        entry=first + torch.arange(2 * width),
        covariance=covariance[None],
    )


def between(joints: Joints, one: int, other: int) -> torch.Tensor:
    rows, columns = joints.entry[joints.owner[one]], joints.entry[joints.owner[other]]
    return joints.covariance[0][rows][:, columns]


def test_blocks_and_changes_are_those_of_their_chains_joints():
    joints = joined(chains=4, blocks=12)
    found = joints.of_blocks(torch.arange(12))
    for k, U in enumerate(joints.goes_with):
        assert torch.allclose(found[k], U @ between(joints, k, k) @ U.T, rtol=1e-12, atol=1e-12)
    pair = torch.tensor([[0, 11], [5, 6]])
    of = torch.eye(3, dtype=torch.double)[:, :2]
    changes = ChainChanges(pair=pair, of=of, column=torch.zeros(2, dtype=torch.long))
    found = joints.of_changes(changes, 0)
    for row, (a, b) in enumerate(pair.tolist()):
        u, v = joints.goes_with[a].T @ of, joints.goes_with[b].T @ of
        both = torch.cat((-u, v))
        upper = torch.cat((between(joints, a, a), between(joints, a, b)), dim=1)
        lower = torch.cat((between(joints, b, a), between(joints, b, b)), dim=1)
        whole = both.T @ torch.cat((upper, lower)) @ both
        assert torch.allclose(found[row], whole.diagonal(), rtol=1e-12, atol=1e-12)


def test_a_drive_of_many_joints_and_blocks_takes_the_memory_of_its_blocks():
    """A copy of the drive's matrix for every block would be 1.3 TB."""
    joints = joined(chains=1000, blocks=40_000)
    found = joints.of_blocks(torch.arange(40_000))
    assert found.shape == (40_000, 3, 3) and bool((found.diagonal(dim1=1, dim2=2) > 0).all())
