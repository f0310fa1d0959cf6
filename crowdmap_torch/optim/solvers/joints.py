"""What chains of one drive have in common: the unknowns at which they are joined, and what these add to variances.

A long drive is cut into chains, and the states where it is cut stay beside the landmarks. Where landmarks are known these
are not. With A of the chains, E between them and the joints, Q of the joints,

    [ A    E ]^-1                                                      U = A^-1 E
    [ E^T  Q ]    has the chains' part  A^-1 + U M^-1 U^T              M = Q - E^T U

and M is block tridiagonal, as a chain lies between two joints. With its blocks D_k and, towards the next one, F_k the
blocks of the inverse Z follow from each other,

    S_k = D_k - F_k-1^T G_k-1        G_k = S_k^-1 F_k        Z_kk = S_k^-1 + G_k Z_k+1,k+1 G_k^T        Z_kj = -G_k Z_k+1,j

so that time and memory grow with the number of joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.optim.solvers.block_elimination import KeptLead
from crowdmap_torch.optim.solvers.elimination import ChainStructure
from crowdmap_torch.optim.solvers.parts import Part
from crowdmap_torch.optim.solvers.staying_blocks import StayingBlocks
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.processes.sums import add_at
from crowdmap_torch.processes.threads import in_order

_AT_ONCE = 1 << 12
"""Blocks that joints add to together on a CPU."""
_NUMBERS = 1 << 19
"""Numbers of right-hand sides that are solved for at once on a CPU."""


@dataclass(frozen=True)
class JointChain:
    """The covariance of joints along their drives, everything else known."""

    own: Float[Tensor, "joints w w"]
    """Of each joint, Z_kk."""
    towards: Float[Tensor, "joints w w"]
    """-G_k: takes the covariance of the next one with any further on to that of this one; zero where none is next."""

    @classmethod
    def of(
        cls,
        diagonal: Float[Tensor, "joints w w"],
        link: Float[Tensor, "joints w w"],
        follows: Bool[Tensor, " joints"],
    ) -> JointChain:
        """That of D and F; which joints follow the one before in its drive."""
        begins = torch.nonzero(~follows)[:, 0]
        count = torch.cat((begins, begins.new_tensor([len(follows)]))).diff()
        towards, own = torch.zeros_like(link), torch.empty_like(diagonal)
        left = diagonal.clone()
        # All drives side by side, joint after joint.
        for step in range(int(count.max()) - 1):
            k = begins[count > step + 1] + step
            towards[k] = -torch.linalg.solve(left[k], link[k])
            left[k + 1] += link[k].mT @ towards[k]
        alone = torch.linalg.inv(left)
        for step in reversed(range(int(count.max()))):
            k = begins[count > step] + step
            # The last one of each drive has none behind it.
            behind = torch.where((count > step + 1)[count > step], k + 1, k)
            G = towards[k]
            beyond = own[behind].where((behind > k)[:, None, None], 0.0)
            own[k] = alone[k] + G @ beyond @ G.mT
        return cls(own, towards)

    def between(self, joint: Int[Tensor, " m"], other: Int[Tensor, " m"]) -> Float[Tensor, "m w w"]:
        """The covariance of joints with others of their drive."""
        first, last = torch.minimum(joint, other), torch.maximum(joint, other)
        found, steps = self.own[last], last - first
        for step in range(1, int(steps.max()) + 1 if len(steps) else 1):
            going = torch.nonzero(steps >= step)[:, 0]
            found[going] = self.towards[last[going] - step] @ found[going]
        return torch.where((joint <= other)[:, None, None], found, found.mT)


@dataclass(frozen=True)
class Joints:
    """What the joints of drives add to the covariances of their chains, everything else known."""

    goes_with: Float[Tensor, "e k q"]
    """U: how each eliminated block goes with its chain's two joints, one behind the other."""
    owner: Int[Tensor, " e"]
    """Chain of each eliminated block."""
    joint: Int[Tensor, "chains 2"]
    """The joints of each chain; of one that has one alone that one twice."""
    covariance: JointChain

    def of_blocks(self, block: Int[Tensor, " m"]) -> Float[Tensor, "m k k"]:
        """What they add to the covariance of eliminated blocks."""
        chain, number = torch.unique(self.owner[block], return_inverse=True)
        of_chain, k = self._of_chains(chain), self.goes_with.shape[1]
        added = of_chain.new_empty(len(block), k, k)
        lot = at_once(_AT_ONCE, block.device)
        for begin in range(0, len(block), lot):
            some = slice(begin, begin + lot)
            U = self.goes_with[block[some]]
            added[some] = U @ of_chain[number[some]] @ U.mT
        return added

    def _of_chains(self, chain: Int[Tensor, " m"]) -> Float[Tensor, "m q q"]:
        """The covariance of the joints of each chain."""
        ends = self.joint[chain].unbind(1)
        rows = [torch.cat([self.covariance.between(a, b) for b in ends], dim=2) for a in ends]
        return torch.cat(rows, dim=1)


def joints_of(
    structure: ChainStructure,
    coupling: Mapping[str, Float[Tensor, "f w _"]],
    hessian: StayingBlocks,
    leads: Sequence[Sequence[KeptLead]],
) -> Joints | None:
    """Those of equations with B `coupling` and C `hessian`, by what rounds leave behind of A; None: there are none."""
    plan = structure.plan
    if plan.joints is None or plan.joint is None or not bool((plan.joint >= 0).any()):
        return None
    # Of other drives' joints nothing is known here.
    used = torch.unique(plan.joint[plan.joint >= 0])
    at = structure.where.entries(plan.joints, used)
    count, width = at.shape
    like = next(iter(coupling.values()))
    chains = len(plan.joint)

    def of_part(
        of: tuple[Part, Sequence[KeptLead]],
    ) -> tuple[Float[Tensor, "n k q"], Float[Tensor, "chains q q"]]:
        part, own = of
        E = _towards_joints(structure, part, coupling, width)
        # Few blocks touch a joint.
        ends = torch.nonzero(E.flatten(1).any(1))[:, 0]
        of_ends, U = E[ends], E
        # In place, a few columns at a time: what is solved is several times as large.
        most = at_once(_NUMBERS, like.device, each=E[..., :1].numel())
        for columns in U.split(most, dim=-1):
            columns.copy_(part.solve(own, columns))
        taken = like.new_zeros(chains, 2 * width, 2 * width)
        add_at(taken, 0, structure.owner[part.block[ends]], of_ends.mT @ U[ends])
        return U, taken

    goes_with = like.new_empty(len(structure.owner), structure.width[plan.chains], 2 * width)
    taken = like.new_zeros(chains, 2 * width, 2 * width)
    every = list(zip(structure.parts, leads, strict=True))
    for (part, _), (U, own) in zip(
        every, in_order(of_part, every, like.device, worth=1), strict=True
    ):
        goes_with[part.block] = U
        taken += own
    known = plan.joint >= 0
    number = torch.searchsorted(used, plan.joint.clamp_min(0))
    # Of a chain that has none of its own, or one, nothing goes with the others that stand here.
    number = torch.where(known, number, -1)
    joint = torch.where(known, number, number.amax(1, keepdim=True)).clamp_min(0)
    # Joints that one chain lies between are of one drive.
    inner = torch.nonzero(known.all(1))[:, 0]
    follows = torch.zeros(count, dtype=torch.bool, device=at.device)
    follows[joint[inner, 1]] = True
    diagonal = hessian.own[plan.joints][used]
    for end in range(2):
        own, side = torch.nonzero(known[:, end])[:, 0], slice(end * width, (end + 1) * width)
        add_at(diagonal, 0, joint[own, end], -taken[own, side, side])
    link = torch.zeros_like(diagonal)
    link[joint[inner, 0]] = -taken[inner, :width, width:]
    return Joints(goes_with, structure.owner, joint, JointChain.of(diagonal, link, follows))


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
