"""The back end for chains: leaves and chains are eliminated round by round, the landmarks are one system of sparse tiles.

Bundle adjustment of a map has frames by the ten thousand, each bound to the next, and landmarks by the hundred: what is
eliminated are the frames, the reverse of the usual habit. With D in A and C already, the normal equations and what is left
of them are

    [ A  B^T ] [ x ]     [ a ]        A: `diagonal`, `link`    B: `coupling`    C: `hessian`
    [ B  C   ] [ y ] = - [ b ]        a: `eliminated_gradient`                  b: `gradient`

    S = C - B A^-1 B^T        S y = -(b - B A^-1 a)        x = -A^-1 (a + B^T y)

the Schur complement on what stays, the reduced system and the back-substitution; of C and S the tiles count that hold
anything (`sparse_tiles`). `elimination` says in which order, `chain_sums` adds the blocks up, `block_elimination` is the
arithmetic of a round.

A journey's constant error touches all its frames, the calibration of a car those of all its journeys. Among the landmarks
such a border would widen every window, and as a block of the chain it would be a neighbour of all. Its columns are the last
of C, and what it has in common with the chains is no part of B but F, `border_link`: `border` adds it to S.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.linearize import row_blocks
from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.assembly import Costs, assemble
from crowdmap_torch.optim.solvers.block_elimination import (
    KeptLead,
    Lead,
    Products,
    eliminate,
    fill_chain,
    lead_of,
)
from crowdmap_torch.optim.solvers.border import (
    ChainBorder,
    border_information,
    sums_of_changes,
    weighted_sums,
)
from crowdmap_torch.optim.solvers.chain_sums import ReducibleSums
from crowdmap_torch.optim.solvers.elimination import ChainStructure, analyse
from crowdmap_torch.optim.solvers.known_landmarks import KnownLandmarks
from crowdmap_torch.optim.solvers.landmark_covariance import LandmarkCovariance
from crowdmap_torch.optim.solvers.layout import SparsityPattern
from crowdmap_torch.optim.solvers.normal_equations import (
    DIAGONAL_FLOOR,
    BorderInformation,
    ChainChanges,
    Correction,
    Step,
    StepPart,
    Tangents,
    failed_step,
    mean_in_sigmas,
    solved_step,
)
from crowdmap_torch.optim.solvers.parts import Part
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix
from crowdmap_torch.optim.solvers.staying_blocks import StayingBlocks
from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky
from crowdmap_torch.optim.solvers.windows import Batch, Round
from crowdmap_torch.optim.solvers.workspace import Factor, Workspace
from crowdmap_torch.processes.sums import add_at
from crowdmap_torch.processes.threads import in_order

_NEXT_TO_NOTHING = 1e-6
"""Share by which diagonals are raised up to which covariances are as good as those of what is not damped."""
_FEW = 4
"""Width of factors up to which a product number by number takes less time than many small ones."""
R = TypeVar("R")
UNOBSERVED_FLOOR = 1e-9
"""Information added to every landmark before its covariance is read: none that nothing observes spoils the others."""


@dataclass
class ChainBackend:
    """Normal equations of one problem, leaves and chains eliminated as planned.

    The order of elimination is worked out when a problem is first seen, and kept for problems whose terms touch the same
    blocks, or such as the plan has room for: weights, constants and losses may change from step to step.
    """

    plan: EliminationPlan
    group_size: int | None = None
    """Blocks that share one window of columns; None: as many as there are chains, from 4 to 64."""
    batch_bytes: int | None = None
    """Size of what is computed at once; None: what suits the device."""
    chunk_rows: int | None = None
    _pattern: SparsityPattern | None = field(default=None, repr=False)
    _structure: ChainStructure | None = field(default=None, repr=False)
    _workspace: Workspace | None = field(default=None, repr=False)

    @torch.no_grad()
    def assemble(self, problem: Problem, values: Values) -> ChainNormalEquations:
        """Normal equations at `values`; memory beyond them is bounded by the chunk.

        The workspace of the solve is the back end's: of its normal equations only the last may be solved.
        """
        structure, workspace = self.prepare(problem, values)
        # The last ones go before the next ones come.
        workspace.factor = None
        coupling = {
            name: workspace.coupling(
                name, (*coupling.column.shape, structure.width[coupling.variable])
            )
            for name, coupling in structure.couplings.factors.items()
        }
        sums = ReducibleSums(structure, problem, values, coupling)
        groups = {name: term.rows for name, term in structure.couplings.terms.items()}
        costs = assemble(
            problem, values, row_blocks, sums.add, groups=groups, chunk_rows=self.chunk_rows
        )
        sums.add_lots()
        return _equations(costs, sums, workspace)

    def prepare(self, problem: Problem, values: Values) -> tuple[ChainStructure, Workspace]:
        """The structure of such a problem and the memory for it, unless both are there already."""
        if self._pattern is None or not self._pattern.is_of(problem, values):
            if problem.group_count != 1:
                raise ValueError("chains are eliminated in one problem at a time, not in a batch")
            before = self._structure
            if self._pattern is None or not self._pattern.is_as_large(problem, values):
                before = None
            self._structure = analyse(
                *(problem, values, self.plan),
                group_size=self.group_size,
                batch_bytes=self.batch_bytes,
                before=before,
            )
            if before is None or self._structure.reduced is not before.reduced:
                block = values[self.plan.chains]
                k = problem.variables[self.plan.chains].tangent_dim
                # The old one goes before the new one comes.
                self._workspace = None
                self._workspace = Workspace.of(self._structure, block.new_empty(0, k))
            self._pattern = SparsityPattern.of(problem, values)
        assert self._structure is not None and self._workspace is not None
        return self._structure, self._workspace


@dataclass(frozen=True)
class ChainNormalEquations:
    """The quadratic model by blocks; the letters are the module's."""

    cost: Float[Tensor, " 1"]
    term_cost: Mapping[str, Float[Tensor, " 1"]]
    structure: ChainStructure
    diagonal: Float[Tensor, "e k k"]
    link: Float[Tensor, "e k k"]
    """Block of each node with its successor, of each leaf with the block that carries it."""
    eliminated_gradient: Float[Tensor, "e k"]
    coupling: Mapping[str, Float[Tensor, "f w _"]]
    """Blocks of B by term, as wide as the eliminated variable."""
    border_link: Float[Tensor, "e k b"]
    """Blocks of F: each eliminated block with its chain's blocks of the border's variables, one behind the other."""
    hessian: StayingBlocks
    gradient: Float[Tensor, " r"]
    workspace: Workspace = field(repr=False)

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step: eliminate round by round, solve what is left, substitute back."""
        of_A, of_C = self.diagonal.diagonal(dim1=-2, dim2=-1), self.hessian.diagonal()
        added_x = damping * of_A.clamp_min(DIAGONAL_FLOOR)
        added_y = damping * of_C.clamp_min(DIAGONAL_FLOOR)
        right_side = self.factorise(added_x, added_y)
        if right_side is None:
            return failed_step(self.unpack(self.eliminated_gradient, self.gradient), self.cost)
        y = -self.solve_reduced(right_side[:, None])[:, 0]
        x = self.substitute(y, self.eliminated_gradient)
        parts = (
            StepPart(x[None], self.eliminated_gradient[None], added_x[None]),
            StepPart(y[None], self.gradient[None], added_y[None]),
        )
        last, count = (StepPart.alone(y, right_side),), self.structure.where.used.sum(1).to(y)
        return solved_step(self.unpack(x, y), *parts, last=last, count=count)

    @property
    def tangent_gradient(self) -> dict[str, Tensor]:
        """The gradient by variable."""
        return self.unpack(self.eliminated_gradient, self.gradient)

    def correct(self, gradient: Tangents) -> Correction:
        """The step for another gradient, by the last factors."""
        where = self.structure.where
        a, b = self.structure.stack(gradient), where.pack(gradient)[0]
        right_side = b - self.couple_all(a)
        y = -self.solve_reduced(right_side[:, None])[:, 0]
        in_sigmas = mean_in_sigmas(-(right_side @ y)[None], where.used.sum(1).to(y))
        return Correction(self.unpack(self.substitute(y, a), y), in_sigmas)

    def unpack(self, x: Float[Tensor, "e k ..."], y: Float[Tensor, "r ..."]) -> dict[str, Tensor]:
        """Tangents by variable."""
        return {**self.structure.where.unpack(y[None]), **self.structure.unstack(x)}

    def covariance(self, *, floor: float = UNOBSERVED_FLOOR) -> LandmarkCovariance:
        """The joint covariance of all that stays, the eliminated blocks marginalised: the inverse of S, undamped.

        The `floor` is added to landmarks alone.
        """
        nothing, added = torch.zeros_like(self.eliminated_gradient), torch.zeros_like(self.gradient)
        added[: self.structure.border_begin] = floor
        if self.factorise(nothing, added) is None:
            raise ValueError("the chains' blocks are not positive definite without damping")
        workspace, factor = self.workspace, self.workspace.factor
        assert factor is not None and factor.reduced is not None
        chains = self.chains(factor.leads)
        return LandmarkCovariance(
            *(self.structure.where, factor.reduced, partial(weighted_sums, chains)),
            lambda: workspace.factor is factor,
        )

    def chains(self, leads: Sequence[Sequence[KeptLead]]) -> ChainBorder:
        """The chains, by what the rounds of every part leave behind, and what binds them to what stays."""
        return ChainBorder(self.structure, self.coupling, self.border_link, leads)

    def conditional_covariance(self, name: str, *, told: float = 1.0) -> Float[Tensor, "n k k"]:
        """Covariance of every block of an eliminated variable, the landmarks known."""
        if told != 1.0:
            # What is known as it is goes first: both at once are the most memory of a step.
            self.__dict__.pop("known", None)
        found = self._of_blocks if told == 1.0 else self._known_if(told).of_blocks()
        return self.structure.unstack(found)[name][..., : self.structure.width[name]]

    def variance_of_leaves(self) -> Float[Tensor, "l k"]:
        """Variance of each leaf's numbers less those of the block that carries it, landmarks and border known."""
        return self.known.of_leaves()

    def variance_of_changes(self, changes: ChainChanges) -> Float[Tensor, "q m"]:
        """Variances of changes along drives, nothing else known, by the last factors."""
        factor = self.workspace.factor
        assert factor is not None and factor.reduced is not None, "solved first"
        known, sums = sums_of_changes(self.chains(factor.leads), changes)
        return changes.variance(known + sums.variance(factor.reduced, changes.drives))

    def border_information(self) -> BorderInformation:
        """Information on the border, everything else marginalised, as the last step had it."""
        factor = self.workspace.factor
        assert factor is not None and factor.reduced is not None, "solved first"
        return border_information(self.structure, factor.reduced, factor.added)

    @cached_property
    def known(self) -> KnownLandmarks:
        """Covariances of eliminated blocks, the landmarks known; by what the last solve left behind if that is as good."""
        factor = self.workspace.factor
        is_own = factor is not None and factor.of is self.eliminated_gradient
        leads = factor.leads if factor is not None and is_own and factor.is_undamped else None
        blocks = self.structure, self.diagonal, self.link, self.coupling, self.hessian
        return KnownLandmarks.of(*blocks, leads)

    @cached_property
    def _of_blocks(self) -> Float[Tensor, "e k k"]:
        """Covariance of every eliminated block, the landmarks known."""
        return self.known.of_blocks()

    def _known_if(self, told: float) -> KnownLandmarks:
        """The same if what leaves see told so many times as much; their prior is what binds them to their carriers."""
        plan, diagonal = self.structure.plan, self.diagonal.clone()
        assert plan.leaves is not None
        leaf, k = slice(0, plan.leaf_count), self.structure.width[plan.leaves]
        seen = self.diagonal[leaf, :k, :k] + self.link[leaf, :k, :k]
        diagonal[leaf, :k, :k] += (told - 1) * (seen + seen.mT) / 2
        return KnownLandmarks.of(self.structure, diagonal, self.link, self.coupling, self.hessian)

    def factorise(
        self, added_x: Float[Tensor, "e k"], added_y: Float[Tensor, " r"]
    ) -> Float[Tensor, " r"] | None:
        """The right-hand side b - B A^-1 a of the reduced system, which is factorised; None: it is not positive definite.

        The arguments are added to the diagonals of A and C. Of S only the upper triangle counts.
        """
        system, eliminated = self.reduce(added_x, added_y)
        # What is not positive definite on the way gives numbers that are not finite, and the factors none either.
        reduced = TiledCholesky.of(system)
        if reduced is None:
            self.workspace.factor = None
            return None
        self.workspace.factor = replace(eliminated, reduced=reduced)
        return system.right_side

    def reduce(
        self, added_x: Float[Tensor, "e k"], added_y: Float[Tensor, " r"] | None
    ) -> tuple[TileMatrix, Factor]:
        """The reduced system S and its right-hand side, and what the elimination leaves behind, for later solves.

        The arguments are added to the diagonals of A and C.
        """
        structure, system = self.structure, self.workspace.system()
        self.hessian.add_to(system)
        system.right_side.copy_(self.gradient)
        if added_y is not None:
            system.add_diagonal(added_y + structure.where.gaps)
        leads = self._eliminate_all(added_x, system)
        self.chains(leads).add(system, self.eliminated_gradient)
        is_undamped = not bool(
            (added_x > _NEXT_TO_NOTHING * self.diagonal.diagonal(dim1=-2, dim2=-1)).any()
        )
        added = torch.zeros_like(self.gradient) if added_y is None else added_y
        factor = Factor(leads, None, self.eliminated_gradient, is_undamped, added)
        self.workspace.factor = factor
        return system, factor

    def _eliminate_all(
        self, added: Float[Tensor, "e k"], system: TileMatrix
    ) -> tuple[tuple[KeptLead, ...], ...]:
        """Takes all chains off the reduced system, and hands back what the rounds of every part leave behind."""
        parts, lanes = self.structure.parts, self.structure.lanes

        def eliminated(lane: int) -> tuple[list[tuple[KeptLead, ...]], TileMatrix]:
            own = TileMatrix.zeros(system.pattern, system.flat) if lane else system
            return [self._eliminate(parts[i], added, own) for i in lanes[lane]], own

        leads: dict[int, tuple[KeptLead, ...]] = {}
        done = in_order(eliminated, range(len(lanes)), system.flat.device, worth=1)
        for lane, (of_lane, own) in zip(lanes, done, strict=True):
            leads |= zip(lane, of_lane, strict=True)
            if own is not system:
                system.flat.add_(own.flat)
        return tuple(leads[i] for i in range(len(parts)))

    def _eliminate(
        self, part: Part, added: Float[Tensor, "e k"], system: TileMatrix
    ) -> tuple[KeptLead, ...]:
        """Takes a part's chains off the reduced system, round by round, and hands back what the rounds leave behind."""
        structure, products = self.structure, Products(system)
        store = self._filled(self.workspace.store(part.store_rows + 1), part)
        diagonal, link = part.by_place(self.diagonal, self.link, added)
        leads = []
        for of_round in part.rounds:
            lead = lead_of(of_round, diagonal, link)
            leads.append(lead.kept())
            fill_chain(of_round, lead.square(), diagonal, link)

            def eliminated(batch: Batch, of_round: Round = of_round, lead: Lead = lead):
                here = of_round.of_batch(batch)
                own = lead.whiten[here], lead.towards[here]
                return eliminate(batch, *own, store, structure.reduced)

            done = in_order(eliminated, of_round.batches, store.device, worth=1)
            for batch, found in zip(of_round.batches, done, strict=True):
                add_at(store, 0, batch.fill.flatten().long(), found.fill)
                if found.scattered is not None:
                    add_at(system.flat, 0, *found.scattered)
                elif batch.products is not None:
                    products.add(batch.products, found.wide)
        products.subtract()
        return tuple(leads)

    def _filled(self, store: Float[Tensor, "rows k"], part: Part) -> Float[Tensor, "rows k"]:
        """A store with a part's couplings and gradient, in place."""
        store.zero_()
        for name, own in part.factors.items():
            rows, block = part.factor_rows[name], self.coupling[name][own].flatten(0, 1)
            narrow = store[:, : block.shape[1]]
            if name in part.alone:
                narrow.index_copy_(0, rows, block)
            else:
                add_at(narrow, 0, rows, block)
        store[part.right_side_row] = self.eliminated_gradient[part.block]
        return store

    def solve_reduced(self, right_side: Float[Tensor, "r c"]) -> Float[Tensor, "r c"]:
        """S^-1 of right-hand sides, by the last factors."""
        factor = self.workspace.factor
        assert factor is not None and factor.reduced is not None
        return factor.reduced.solve(right_side)

    def couple_all(self, gradient: Float[Tensor, "e k"]) -> Float[Tensor, " r"]:
        """What eliminated blocks tell of what stays: B A^-1 a, and F^T A^-1 a of the border, by the last factors."""
        structure, total = self.structure, torch.zeros_like(self.gradient)
        x = torch.empty_like(gradient)

        def told_by(part: Part, leads: Sequence[KeptLead]) -> Float[Tensor, " r"]:
            x[part.block] = part.solve(leads, gradient[part.block][..., None])[..., 0]
            told = torch.zeros_like(total)
            for name, own in part.factors.items():
                coupling, block = structure.couplings.factors[name], self.coupling[name][own]
                of_block = x.index_select(0, coupling.block[own])[:, : block.shape[2], None]
                add_at(told, 0, coupling.column[own].flatten(), (block @ of_block).flatten())
            return told

        for told in self._by_part(told_by):
            total += told
        # A transposed F would be copied, which is as large as it gets.
        told = (x[:, None] @ self.border_link)[:, 0]
        by_chain = add_at(told.new_zeros(structure.border.shape), 0, structure.owner, told)
        return add_at(total, 0, structure.border.flatten(), by_chain.flatten())

    def substitute(
        self, y: Float[Tensor, " r"], gradient: Float[Tensor, "e k"]
    ) -> Float[Tensor, "e k"]:
        """The steps of the eliminated blocks where what stays makes the step y, by the last factors."""
        of_border = y[self.structure.border][self.structure.owner]
        right_side = gradient + (self.border_link @ of_border[..., None])[..., 0]

        def step_of(part: Part, leads: Sequence[KeptLead]) -> None:
            # What is a part's own is no other's: all are in the same memory.
            for name, own in part.factors.items():
                coupling, block = self.structure.couplings.factors[name], self.coupling[name][own]
                column, at = coupling.column[own], coupling.block[own]
                of_factor = y.index_select(0, column.flatten()).view(column.shape)
                add_at(right_side[:, : block.shape[2]], 0, at, _rows_times(of_factor, block))
            solved = part.solve(leads, right_side[part.block][..., None])[..., 0]
            right_side[part.block] = -solved

        for _ in self._by_part(step_of):
            pass
        return right_side

    def _by_part(self, function: Callable[[Part, Sequence[KeptLead]], R]) -> Iterator[R]:
        """What comes of every part and of what its rounds have left behind, in order."""
        factor = self.workspace.factor
        assert factor is not None
        every = list(zip(self.structure.parts, factor.leads, strict=True))
        return in_order(lambda of: function(*of), every, self.gradient.device, worth=1)


def _rows_times(rows: Float[Tensor, "f w"], block: Float[Tensor, "f w k"]) -> Float[Tensor, "f k"]:
    """The products of rows and their blocks."""
    if rows.shape[1] > _FEW:
        return torch.bmm(rows[:, None], block)[:, 0]
    total = block[:, 0] * rows[:, :1]
    for i in range(1, rows.shape[1]):
        total.addcmul_(block[:, i], rows[:, i : i + 1])
    return total


def _equations(costs: Costs, sums: ReducibleSums, workspace: Workspace) -> ChainNormalEquations:
    return ChainNormalEquations(
        cost=costs.total,
        term_cost=costs.by_term,
        structure=sums.structure,
        diagonal=sums.diagonal(),
        link=sums.link,
        eliminated_gradient=sums.gradient(),
        coupling=sums.coupling,
        border_link=sums.border_link,
        hessian=sums.hessian_of_stays(),
        gradient=sums.gradient_of_stays(),
        workspace=workspace,
    )
