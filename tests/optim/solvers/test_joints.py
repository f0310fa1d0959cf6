"""What joints add, held to the plain product; that whole adjustments are those of uncut drives is in test_chain_schur.py."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.optim.solvers import joints as joints_module
from crowdmap_torch.optim.solvers.joints import JointChain, Joints


def joined(chains: int, blocks: int, width: int = 2) -> tuple[Joints, torch.Tensor, torch.Tensor]:
    """Two drives of chains between joints, and as many blocks of each, chain by chain; D and F of the joints."""
    make = torch.Generator().manual_seed(7)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.double, generator=make)

    count = 2 * (chains + 1)
    follows = torch.arange(count) % (chains + 1) != 0
    link = 0.3 * noise(count, width, width)
    link[torch.arange(count) % (chains + 1) == chains] = 0
    root = noise(count, width, width)
    diagonal = root @ root.mT + 5 * torch.eye(width)
    first = torch.arange(2 * chains) + (torch.arange(2 * chains) >= chains)
    joints = Joints(
        goes_with=noise(2 * blocks, 3, 2 * width),
        owner=torch.arange(2 * blocks) * chains // blocks,
        joint=torch.stack((first, first + 1), dim=1),
        covariance=JointChain.of(diagonal, link, follows),
    )
    return joints, diagonal, link


def between(
    joints: Joints, diagonal: torch.Tensor, link: torch.Tensor, one: int, other: int
) -> torch.Tensor:
    """Of the inverse of the whole matrix."""
    count, width = len(diagonal), diagonal.shape[1]
    whole = torch.block_diag(*diagonal)
    for k in range(count - 1):
        here, there = slice(k * width, (k + 1) * width), slice((k + 1) * width, (k + 2) * width)
        whole[here, there], whole[there, here] = link[k], link[k].T
    rows, columns = (
        (joints.joint[joints.owner[at]][:, None] * width + torch.arange(width)).flatten()
        for at in (one, other)
    )
    return torch.linalg.inv(whole)[rows][:, columns]


@pytest.mark.parametrize("lot", [5, 1 << 12])
def test_blocks_are_those_of_their_chains_joints(lot: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(joints_module, "_AT_ONCE", lot)
    joints, diagonal, link = joined(chains=4, blocks=12)
    found = joints.of_blocks(torch.arange(24))
    for k, U in enumerate(joints.goes_with):
        expected = U @ between(joints, diagonal, link, k, k) @ U.T
        assert torch.allclose(found[k], expected, rtol=1e-12, atol=1e-12)


def test_a_drive_of_many_joints_and_blocks_takes_the_memory_of_its_blocks():
    """A copy of the drive's matrix for every block would be 1.3 TB."""
    joints, *_ = joined(chains=1000, blocks=40_000)
    found = joints.of_blocks(torch.arange(40_000))
    assert found.shape == (40_000, 3, 3) and bool((found.diagonal(dim1=1, dim2=2) > 0).all())
