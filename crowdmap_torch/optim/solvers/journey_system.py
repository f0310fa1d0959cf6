"""The map's normal equations as a sum over drives: drives meet in landmarks and in the border alone.

Eliminating all that is a drive's own leaves its summand of the reduced system of `chain_schur`, over the landmarks and the
blocks of the border that it has to do with:

    S = C + sum_d S_d        S_d = C_d - B_d A_d^-1 B_d^T        S y = -(b + sum_d (b_d - B_d A_d^-1 a_d))

with C and b of what is known of the map without any drive. Members make the summands of their drives, each a
`JourneySystem`; the leader adds them up in the members' order, factors the sum and tells all of them the step y of what
stays, with which each finds that of its own. The map is the same to the last bit wherever the members are. A sum from
which some are left out is that of a map without their drives: `MapSystem`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.assembly import Costs, of_everybody
from crowdmap_torch.optim.solvers.border import (
    ChainBorder,
    Sums,
    WeightedSums,
    border_information,
    sums_of_changes,
    weighted_sums,
)
from crowdmap_torch.optim.solvers.chain_schur import (
    UNOBSERVED_FLOOR,
    ChainBackend,
    ChainNormalEquations,
)
from crowdmap_torch.optim.solvers.landmark_covariance import LandmarkCovariance
from crowdmap_torch.optim.solvers.layout import Layout
from crowdmap_torch.optim.solvers.normal_equations import (
    DIAGONAL_FLOOR,
    BorderInformation,
    ChainChanges,
    Correction,
    Step,
    Tangents,
    failed_step,
    mean_in_sigmas,
)
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix, TilePattern
from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky
from crowdmap_torch.processes.memory import give_back
from crowdmap_torch.processes.sums import add_at
from crowdmap_torch.processes.together import Together

_AT_ONCE = 1 << 20
"""Numbers of a summand that are added at once: where all of them go to takes three times their own memory."""


@dataclass(frozen=True)
class JourneySystem:
    """What some drives say of the map at one point: one summand of its normal equations."""

    block: Mapping[str, Int[Tensor, " _"]]
    """By variable the rows of the landmarks that it says something of, and of blocks of the border."""
    point: Values
    """Where these are: what it says holds there."""
    cost: Float[Tensor, " 1"]
    """Of what is the drives' own, there."""
    tile: Int[Tensor, "n 2"]
    """Row and column of every tile of S_d that holds anything, on the diagonal and above it, in the landmarks' grid."""
    entry: Int[Tensor, " m"]
    """Where its numbers are in these tiles, one tile behind the other; all others are zero."""
    information: Float[Tensor, " m"]
    """The numbers."""
    row: Int[Tensor, " k"]
    """The rows of tiles that it has to do with: where its landmarks are."""
    right_side: Float[Tensor, "k w"]
    """Of b_d - B_d A_d^-1 a_d, there."""

    @classmethod
    def of(
        cls, system: TileMatrix, where: Layout, values: Values, cost: Float[Tensor, " 1"]
    ) -> JourneySystem:
        """A reduced system and its right-hand side, of blocks that are `where` in it; the tensors are copies."""
        pattern = system.pattern
        area, flat = pattern.width**2, system.tiles.flatten()
        at = torch.nonzero(flat)[:, 0]
        used, number = torch.unique_consecutive(at // area, return_inverse=True)
        padded = system.right_side.new_zeros(pattern.tiles * pattern.width)
        padded[: pattern.dim] = system.right_side
        by_row = padded.view(-1, pattern.width)
        row = torch.nonzero(by_row.any(1))[:, 0]
        # Of drives most tiles hold little: it goes to where it is added up in a quarter of their size.
        entry = (number * area + at % area).to(torch.int32)
        told = system.diagonal() != 0
        block = {
            name: torch.nonzero(told[where.entries(name, slice(None))].any(1))[:, 0]
            for name in where.offset
        }
        return cls(
            *(block, {name: values[name][of] for name, of in block.items()}, cost),
            *(torch.nonzero(pattern.present)[used], entry, flat[at], row, by_row[row]),
        )

    def holds_at(self, values: Values) -> bool:
        """Whether that is the point where its landmarks are."""
        return all(
            torch.equal(values[name][of], self.point[name]) for name, of in self.block.items()
        )

    def add_to(self, system: TileMatrix) -> None:
        """Adds it to a system whose grid is the same and that has its tiles, in place."""
        pattern = system.pattern
        area, of_row = pattern.width**2, self.tile[:, 0] * pattern.tiles + self.tile[:, 1]
        begin = pattern.base[: pattern.tiles, : pattern.tiles].flatten()[of_row]
        assert bool((begin >= 0).all()), "the sum has the tiles of its summands"
        for of in range(0, len(self.entry), _AT_ONCE):
            entry = self.entry[of : of + _AT_ONCE].long()
            place = begin[entry // area] + entry % area
            add_at(system.flat, 0, place, self.information[of : of + _AT_ONCE])
        padded = system.flat[pattern.count * area :][: pattern.tiles * pattern.width]
        add_at(padded.view(-1, pattern.width), 0, self.row, self.right_side)


@dataclass
class JourneyBackend:
    """Normal equations of a problem of which each member has the drives, and the leader the map.

    The plans are those of the members' own chains, with the landmarks ranked alike; the leader has no chain.
    """

    plan: EliminationPlan
    together: Together
    _chains: ChainBackend = field(init=False, repr=False)
    _summed: Summed = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._chains, self._summed = ChainBackend(self.plan), Summed()

    def assemble(self, problem: Problem, values: Values) -> JourneyEquations:
        """Normal equations at `values`, of which the last may be solved."""
        own = self._chains.assemble(problem, values)
        costs, total = of_everybody(
            problem,
            Costs(own.cost, own.term_cost),
            {"gradient": own.gradient, "diagonal": own.hessian.diagonal()},
        )
        present = own.structure.reduced.present
        tiles = torch.nonzero(present).to(torch.int32)
        self.together.for_leader(partial(self._summed.make_room, own), tiles)
        return JourneyEquations(
            *(costs.total, costs.by_term, own, self.together),
            *(total["gradient"], total["diagonal"]),
            *(values, self._summed),
        )


@dataclass
class Summed:
    """The sum of all systems, of the last normal equations: the leader's; a member's is empty."""

    system: TileMatrix | None = None
    factor: TiledCholesky | None = None
    added: Float[Tensor, " r"] | None = None
    """To the diagonal of C."""

    def make_room(self, own: ChainNormalEquations, tiles: Iterator[Int[Tensor, "n 2"]]) -> None:
        """Memory for the sum of systems with these tiles, unless it is there already."""
        # The last factors are in the same memory.
        self.factor = None
        pattern = own.structure.reduced
        present = _with_tiles(pattern, tiles)
        if self.system is not None and (
            present.shape == self.system.pattern.present.shape
            and not bool((present & ~self.system.pattern.present).any())
        ):
            return
        # The old one goes before the new one comes.
        self.system = None
        self.system = TileMatrix.zeros(_filled(pattern, present), own.gradient)

    def factorise(
        self, added: Float[Tensor, " r"], parts: Iterator[JourneySystem], values: Values
    ) -> Float[Tensor, " r"] | None:
        """The right-hand side of the sum at `values`, which is factorised; None: it is not positive definite."""
        system = self.system
        assert system is not None, "of the leader"
        self.factor = None
        system.flat.zero_()
        for part in parts:
            assert part.holds_at(values), "systems of one point are added up"
            part.add_to(system)
            del part
            give_back()
        system.add_diagonal(added)
        self.factor, self.added = TiledCholesky.of(system), added
        return None if self.factor is None else system.right_side

    def solve(self, right_side: Float[Tensor, " r"]) -> Float[Tensor, " r"]:
        """The inverse of the sum times a right-hand side, by the last factors."""
        assert self.factor is not None
        return self.factor.solve(right_side[:, None])[:, 0]


@dataclass(frozen=True)
class JourneyEquations:
    """The quadratic model of all, as one of them has it; letters as in `chain_schur`."""

    cost: Float[Tensor, " 1"]
    """Of all."""
    term_cost: Mapping[str, Float[Tensor, " 1"]]
    own: ChainNormalEquations
    """Of one's own terms."""
    together: Together
    gradient: Float[Tensor, " r"]
    """b, of all."""
    diagonal: Float[Tensor, " r"]
    """Of C, of all."""
    values: Values = field(repr=False)
    """The point."""
    summed: Summed = field(repr=False)

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step of what stays, and of one's own chains."""
        own, together = self.own, self.together
        of_A = own.diagonal.diagonal(dim1=-2, dim2=-1)
        added_x = damping * of_A.clamp_min(DIAGONAL_FLOOR)
        added_y = damping * self.diagonal.clamp_min(DIAGONAL_FLOOR)

        def stepped(parts: Iterator[JourneySystem]) -> tuple[Tensor, Tensor] | None:
            right_side = self.summed.factorise(
                added_y + own.structure.where.gaps, parts, self.values
            )
            if right_side is None:
                return None
            y = -self.summed.solve(right_side)
            return y, -(right_side @ y)[None]

        found = together.met(stepped, self._system(added_x))
        if found is None:
            return failed_step(own.unpack(own.eliminated_gradient, own.gradient), self.cost)
        y, along_last = found
        x = own.substitute(y, own.eliminated_gradient)
        of_x = _along(x, own.eliminated_gradient, added_x)
        of_y = _along(y, self.gradient, added_y)
        along, damped, squared = together.sum(of_x + of_y if together.leads else of_x).split(1)
        norm = squared.sqrt()
        solved = norm.isfinite()
        return Step(
            delta=own.unpack(x, y),
            predicted=torch.where(solved, (damped - along) / 2, 0.0),
            solved=solved,
            norm=norm,
            in_sigmas=mean_in_sigmas(along_last, own.structure.where.used.sum(1).to(y)),
        )

    def _system(self, added_x: Float[Tensor, "e k"]) -> JourneySystem:
        """One's own summand."""
        own = self.own
        system, _ = own.reduce(added_x, None)
        return JourneySystem.of(system, own.structure.where, self.values, own.cost)

    def systems(self) -> MapSystem | None:
        """The summands of all, of what is undamped: the leader's; of a member nothing."""
        own = self.own

        def of_all(parts: Iterator[JourneySystem]) -> MapSystem:
            layout = own.structure.where, own.structure.reduced
            return MapSystem(*layout, self.values, tuple(parts))

        return self.together.for_leader(
            of_all, self._system(torch.zeros_like(own.eliminated_gradient))
        )

    @property
    def tangent_gradient(self) -> dict[str, Tensor]:
        """The gradient by variable, of all."""
        return self.own.unpack(self.own.eliminated_gradient, self.gradient)

    def correct(self, gradient: Tangents) -> Correction:
        """The step for another gradient, by the last factors."""
        own = self.own
        a, b = own.structure.stack(gradient), own.structure.where.pack(gradient)[0]

        def stepped(parts: Iterator[Float[Tensor, " r"]]) -> tuple[Tensor, Tensor]:
            right_side = b.clone()
            for part in parts:
                right_side -= part
            y = -self.summed.solve(right_side)
            return y, -(right_side @ y)[None]

        y, along_last = self.together.met(stepped, own.couple_all(a))
        in_sigmas = mean_in_sigmas(along_last, own.structure.where.used.sum(1).to(y))
        return Correction(own.unpack(own.substitute(y, a), y), in_sigmas)

    def covariance(self, *, floor: float = UNOBSERVED_FLOOR) -> LandmarkCovariance:
        """The joint covariance of all that stays: the leader's, while members `share_covariance`."""
        self.share_covariance(floor=floor)
        summed, factor = self.summed, self.summed.factor
        assert factor is not None, "of the leader"
        where, is_current = self.own.structure.where, lambda: summed.factor is factor
        return LandmarkCovariance(where, factor, self.sums_of_chains, is_current)

    def share_covariance(self, *, floor: float = UNOBSERVED_FLOOR) -> None:
        """Brings one's own summand of what is undamped to the leader, which factors the sum."""
        own = self.own
        added = own.structure.where.gaps.to(self.gradient)
        added[: own.structure.border_begin] += floor

        def factored(parts: Iterator[JourneySystem]) -> bool:
            return self.summed.factorise(added, parts, self.values) is not None

        nothing = torch.zeros_like(own.eliminated_gradient)
        if not self.together.met(factored, self._system(nothing)):
            raise ValueError("the chains' blocks are not positive definite without damping")

    def sums_of_chains(
        self, weight: Float[Tensor, "n k m"], of: Int[Tensor, " chains"], count: int
    ) -> Sums | None:
        """`weighted_sums` of all chains, of which each brings those of its own; of a member nothing."""
        own = weighted_sums(self._chains, weight, of, count)
        return self.together.for_leader(_all_sums, _brought(own))

    def conditional_covariance(self, name: str, *, told: float = 1.0) -> Float[Tensor, "n k k"]:
        """Covariance of every block of one's own, the landmarks known."""
        return self.own.conditional_covariance(name, told=told)

    def variance_of_leaves(self) -> Float[Tensor, "l k"]:
        """Variance of each own leaf's numbers less those of the block that carries it, landmarks and border known."""
        return self.own.variance_of_leaves()

    def variance_of_changes(self, changes: ChainChanges) -> Float[Tensor, "q m"]:
        """Variances of changes along own drives, nothing else known, by the last factors."""

        def of_all(parts: Iterator[_Brought]) -> Float[Tensor, "drives c c"]:
            assert self.summed.factor is not None, "solved first"
            known, sums = _all_sums(parts)
            return known + sums.variance(self.summed.factor, changes.drives)

        own = sums_of_changes(self._chains, changes)
        return changes.variance(self.together.met(of_all, _brought(own)))

    @property
    def _chains(self) -> ChainBorder:
        """One's own, by the last factors."""
        factor = self.own.workspace.factor
        assert factor is not None, "solved first"
        return self.own.chains(factor.leads)

    def border_information(self) -> BorderInformation:
        """Information on the border, everything else marginalised, as the last step had it; of a member nothing."""
        summed = self.summed
        if summed.factor is None or summed.added is None:
            return BorderInformation(self.gradient.new_zeros(0, 0), {})
        return border_information(self.own.structure, summed.factor, summed.added)


@dataclass(frozen=True)
class MapSystem:
    """The summands of a map's normal equations at one point, any of which may be left out."""

    where: Layout
    pattern: TilePattern
    """Of the landmarks' grid, whichever tiles it has."""
    values: Values
    """The point."""
    systems: tuple[JourneySystem, ...]
    """The leader's, of what is known without any drive, then one for each member."""

    @property
    def of_drives(self) -> tuple[JourneySystem, ...]:
        """The members'."""
        return self.systems[1:]

    def step(self, *, without: Collection[int] = ()) -> dict[str, Tensor] | None:
        """The step to the least cost of all but some members, numbered from 0, by variable; of what is common to all.

        Landmarks that nobody else saw stay where what is known without any drive holds them. None: the sum is not positive
        definite.
        """
        systems = [one for n, one in enumerate(self.systems) if n - 1 not in without or not n]
        present, like = _with_tiles(self.pattern, (one.tile for one in systems)), self.systems[0]
        summed = Summed(TileMatrix.zeros(_filled(self.pattern, present), like.information))
        added = torch.where(self.where.gaps, 1.0, UNOBSERVED_FLOOR).to(like.information)
        right_side = summed.factorise(added, iter(systems), self.values)
        return None if right_side is None else self.where.unpack(-summed.solve(right_side)[None])


def _with_tiles(pattern: TilePattern, tiles: Iterator[Int[Tensor, "n 2"]]) -> Bool[Tensor, "t t"]:
    """Which tiles of a grid some have."""
    present = torch.zeros_like(pattern.present)
    for tile in tiles:
        row, column = tile.long().unbind(1)
        present[row, column] = True
    return present


def _filled(pattern: TilePattern, present: Bool[Tensor, "t t"]) -> TilePattern:
    """That of the factor of a matrix with these tiles of a grid."""
    of = TilePattern.of(pattern.dim, pattern.width, present.cpu().numpy(), present.device)
    return of.filled()


def _along(step: Tensor, gradient: Tensor, added: Tensor) -> Float[Tensor, " 3"]:
    """g.s, s.D s and s.s."""
    return torch.stack(
        [(gradient * step).sum(), (added * step.square()).sum(), step.square().sum()]
    )


_Brought = tuple[Tensor, tuple[Tensor, Tensor, Tensor]]
"""`Sums` as they are brought to a meeting."""


def _brought(own: Sums) -> _Brought:
    known, sums = own
    return known, (sums.row, sums.of, sums.value)


def _all_sums(parts: Iterator[_Brought]) -> Sums:
    every = list(parts)
    own = torch.stack([of for of, _ in every]).sum(0)
    return own, WeightedSums(
        *(torch.cat(each) for each in zip(*(sums for _, sums in every), strict=True))
    )
