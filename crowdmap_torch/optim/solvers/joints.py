"""What chains of one drive have in common: the unknowns at which they are joined, and what these add to variances.

A long drive is cut into chains, and the states where it is cut stay beside the landmarks. Where landmarks are known these
are not. With A of the chains, E between them and the joints, Q of the joints,

    [ A    E ]^-1                                                      U = A^-1 E
    [ E^T  Q ]    has the chains' part  A^-1 + U M^-1 U^T              M = Q - E^T U

and M is a small matrix for every drive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.solvers.block_elimination import Lead
from crowdmap_torch.optim.solvers.elimination import ChainStructure
from crowdmap_torch.optim.solvers.normal_equations import ChainChanges
from crowdmap_torch.optim.solvers.parts import Part
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix
from crowdmap_torch.processes.threads import in_order


@dataclass(frozen=True)
class Joints:
    """What the joints of drives add to the covariances of their chains, everything else known."""

    goes_with: Float[Tensor, "e k q"]
    """U: how each eliminated block goes with its chain's two joints, one behind the other."""
    owner: Int[Tensor, " e"]
    """Chain of each eliminated block."""
    drive: Int[Tensor, " chains"]
    """Drive of each chain, of those that are joined."""
    entry: Int[Tensor, "chains q"]
    """Where in its drive the chain's joints are."""
    covariance: Float[Tensor, "d n n"]
    """M^-1, by drive."""

    def of_blocks(self, block: Int[Tensor, " m"]) -> Float[Tensor, "m k k"]:
        """What they add to the covariance of eliminated blocks."""
        U = self.goes_with[block]
        return U @ self._between(self.owner[block], self.owner[block]) @ U.mT

    def of_changes(self, changes: ChainChanges, first_block: int) -> Float[Tensor, "q m"]:
        """What they add to the variances of changes; chains' blocks are counted from `first_block` on."""
        first, second = (changes.pair + first_block).unbind(1)
        a, b = self.goes_with[first].mT @ changes.of, self.goes_with[second].mT @ changes.of
        of_first, of_second = self.owner[first], self.owner[second]

        def product(
            left: Tensor, chain: Tensor, other: Tensor, right: Tensor
        ) -> Float[Tensor, "q m"]:
            return (left * (self._between(chain, other) @ right)).sum(1)

        alone = product(a, of_first, of_first, a) + product(b, of_second, of_second, b)
        return alone - 2 * product(a, of_first, of_second, b)

    def _between(
        self, chain: Int[Tensor, " m"], other: Int[Tensor, " m"]
    ) -> Float[Tensor, "m q q"]:
        """The covariance of chains' joints with those of others of their drive."""
        # A drive's matrix is not copied once for each chain's row: drives have many joints and many rows.
        row, column = self.entry[chain][:, :, None], self.entry[other][:, None]
        return self.covariance[self.drive[chain][:, None, None], row, column]


def joints_of(
    structure: ChainStructure,
    coupling: Mapping[str, Float[Tensor, "f w _"]],
    hessian: TileMatrix,
    leads: Sequence[Sequence[Lead]],
) -> Joints | None:
    """Those of equations with B `coupling` and C `hessian`, by what rounds leave behind of A; None: there are none."""
    plan = structure.plan
    if plan.joints is None or plan.joint is None or not len(structure.where.offset[plan.joints]):
        return None
    at = structure.where.entries(plan.joints, slice(None))
    count, width = at.shape
    like = next(iter(coupling.values()))
    chains = len(plan.joint)

    def of_part(
        of: tuple[Part, Sequence[Lead]],
    ) -> tuple[Float[Tensor, "n k q"], Float[Tensor, "chains q q"]]:
        part, own = of
        E = _towards_joints(structure, part, coupling, width)
        U = part.solve(own, E)
        # Few blocks touch a joint.
        ends = torch.nonzero(E.flatten(1).any(1))[:, 0]
        taken = like.new_zeros(chains, 2 * width, 2 * width)
        taken.index_add_(0, structure.owner[part.block[ends]], E[ends].mT @ U[ends])
        return U, taken

    goes_with = like.new_empty(len(structure.owner), structure.width[plan.chains], 2 * width)
    taken = like.new_zeros(chains, 2 * width, 2 * width)
    every = list(zip(structure.parts, leads, strict=True))
    for (part, _), (U, own) in zip(
        every, in_order(of_part, every, like.device, worth=1), strict=True
    ):
        goes_with[part.block] = U
        taken += own
    known, joint = plan.joint >= 0, plan.joint.clamp_min(0)
    # Joints that one chain lies between are of one drive.
    follows = torch.zeros(count, dtype=torch.bool, device=at.device)
    follows[joint[known.all(1), 1]] = True
    drive = (~follows).cumsum(0) - 1
    begins = torch.nonzero(~follows)[:, 0]
    place = torch.arange(count, device=at.device) - begins[drive]
    most, drives = int(place.max()) + 1, len(begins)
    M = torch.eye(most * width).to(like).repeat(drives, 1, 1)
    inner = torch.arange(width, device=at.device)
    own = place[:, None] * width + inner
    M[drive[:, None, None], own[:, :, None], own[:, None]] = hessian.read(
        at[:, :, None], at[:, None]
    )
    entry = own[joint].flatten(1)
    of_chain = drive[joint.amax(1)]
    area = (of_chain[:, None, None] * most * width + entry[:, :, None]) * most * width
    M.view(-1).index_add_(0, (area + entry[:, None]).flatten(), -taken.flatten())
    return Joints(goes_with, structure.owner, of_chain, entry, torch.linalg.inv(M))


def _towards_joints(
    structure: ChainStructure,
    part: Part,
    coupling: Mapping[str, Float[Tensor, "f w _"]],
    width: int,
) -> Float[Tensor, "n k q"]:
    """E of a part's blocks: each with the joint that its chain begins at and the one that it ends at."""
    plan = structure.plan
    assert plan.joints is not None and plan.joint is not None
    like = next(iter(coupling.values()))
    E = like.new_zeros(len(part.block), structure.width[plan.chains], 2 * width)
    first, count = structure.landmarks.first[plan.joints], len(structure.where.offset[plan.joints])
    for name, own in part.factors.items():
        couples = structure.couplings.factors[name]
        joint = couples.landmark[own, 0] - first
        here = torch.nonzero((joint >= 0) & (joint < count))[:, 0]
        if couples.landmark.shape[1] != 1 or not len(here):
            continue
        row = couples.block[own][here]
        behind = (plan.joint[structure.owner[row], 1] == joint[here]).long()
        column = behind[:, None] * width + torch.arange(width, device=row.device)
        E[structure.number[row][:, None], :, column] += coupling[name][own][here]
    return E
