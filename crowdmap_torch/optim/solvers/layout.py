"""Where the tangents of many blocks lie in one vector, and which blocks the rows of a problem touch."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions, Tangents
from crowdmap_torch.processes.sums import add_at


@dataclass(frozen=True)
class Layout:
    """Where every block's tangent lies: a row of a [groups, dim] array and an offset in it."""

    offset: Mapping[str, Int[Tensor, " n"]]
    group: Mapping[str, Int[Tensor, " n"]]
    tangent_dim: Mapping[str, int]
    dim: int
    used: Bool[Tensor, "groups dim"]
    """False for the padding of groups with fewer unknowns than the largest, and in gaps between sections."""

    @property
    def gaps(self) -> Bool[Tensor, " dim"]:
        """What is nobody's column, of one problem: on the diagonal of what is factored it stands for itself."""
        return ~self.used[0]

    def in_order(
        self, block: Int[Tensor, " q"], section: Int[Tensor, " q"] | None = None, grid: int = 1
    ) -> Layout:
        """The same for one problem, the blocks of all variables, numbered behind each other, in this order.

        Each block's `section`, in this order, begins at a multiple of `grid`, with gaps before it; None: there is one.
        """
        width = torch.cat(
            [
                torch.full((len(at),), self.tangent_dim[name], device=block.device)
                for name, at in self.offset.items()
            ]
            or [block]
        )
        placed, used = in_sections(width[block], section, grid)
        begins = torch.empty_like(block)
        begins[block] = placed
        sizes = [len(at) for at in self.offset.values()]
        offset = dict(zip(self.offset, begins.split(sizes), strict=True))
        return replace(self, offset=offset, dim=len(used), used=used[None])

    def entries(self, name: str, block: Int[Tensor, " m"] | slice) -> Int[Tensor, "m k"]:
        """Where the tangents of blocks of a variable lie."""
        offset = self.offset[name][block]
        return offset[:, None] + torch.arange(self.tangent_dim[name], device=offset.device)

    def unpack(self, packed: Float[Tensor, "groups dim *c"]) -> dict[str, Tensor]:
        """The tangent of every block, by variable, out of packed vectors."""
        every = slice(None)
        return {
            name: packed[self.group[name][:, None], self.entries(name, every)]
            for name in self.offset
        }

    def pack(self, tangents: Tangents) -> Float[Tensor, "groups dim *c"]:
        """Vectors of the tangents of every block, zero in the padding."""
        like = next(iter(tangents.values()))
        packed = like.new_zeros(*self.used.shape, *like.shape[2:])
        for name in self.offset:
            packed[self.group[name][:, None], self.entries(name, slice(None))] = tangents[name]
        return packed


def in_sections(
    width: Int[Tensor, " q"], section: Int[Tensor, " q"] | None, grid: int
) -> tuple[Int[Tensor, " q"], Bool[Tensor, " dim"]]:
    """Where blocks of these widths begin, section by section, each at a multiple of `grid`; and which columns are theirs."""
    begins = width.cumsum(0) - width
    if section is not None and len(section):
        _, of, count = torch.unique_consecutive(section, return_inverse=True, return_counts=True)
        size = add_at(torch.zeros_like(count), 0, of, width)
        room = -(-size // grid) * grid
        room[-1] = size[-1]
        begins = begins + ((room - size).cumsum(0) - (room - size))[of]
    dim = int(begins[-1] + width[-1]) if len(width) else 0
    used = torch.zeros(dim, dtype=torch.bool, device=width.device)
    inner = torch.arange(int(width.sum()), device=width.device)
    inner -= torch.repeat_interleave(width.cumsum(0) - width, width)
    used[torch.repeat_interleave(begins, width) + inner] = True
    return begins, used


def layout(
    problem: Problem, values: Values, *, skip: Collection[str] = (), last: Collection[str] = ()
) -> Layout:
    """Blocks of every variable (but those in `skip`) packed behind each other, group by group; `last` come last."""
    first = next(iter(values.values()))
    used_dim = torch.zeros(problem.group_count, dtype=torch.long, device=first.device)
    offset, group = {}, {}
    every = [name for name in problem.variables if name not in {*skip, *last}]
    for name in (*every, *last):
        variable = problem.variables[name]
        n = len(values[name])
        of = variable.group
        of = torch.zeros(n, dtype=torch.long, device=first.device) if of is None else of
        order = torch.argsort(of, stable=True)
        counts = torch.bincount(of, minlength=problem.group_count)
        rank = torch.empty_like(of)
        rank[order] = torch.arange(n, device=of.device) - (counts.cumsum(0) - counts)[of[order]]
        offset[name] = used_dim[of] + rank * variable.tangent_dim
        group[name] = of
        used_dim = used_dim + counts * variable.tangent_dim
    dim = int(used_dim.max()) if len(used_dim) else 0
    used = torch.arange(dim, device=first.device)[None] < used_dim[:, None]
    dims = {name: problem.variables[name].tangent_dim for name in offset}
    return Layout(offset, group, dims, dim, used)


def read_entries(
    functions: LinearFunctions, where: Layout
) -> tuple[Int[Tensor, "n q"], Float[Tensor, "n m q"]]:
    """The packed entries that each row's functions read, and their derivatives by them."""
    for name, _ in functions.slots:
        if name not in where.offset:
            raise ValueError(f"{name!r} is none of the variables {sorted(where.offset)}")
    at = torch.cat([where.entries(name, block) for name, block in functions.slots], dim=-1)
    J = torch.cat(functions.jacobians, dim=-1)
    read = (J != 0).flatten(0, 1).any(0)
    return at[:, read], J[..., read]


@dataclass(frozen=True)
class SparsityPattern:
    """Which blocks the rows of every term touch: all that an order of elimination depends on, weights and values apart."""

    sizes: Mapping[str, tuple[int, int]]
    """By variable the number of its blocks and the dimension of their tangents."""
    slots: Mapping[str, tuple[tuple[str, Int[Tensor, " m"]], ...]]

    @classmethod
    def of(cls, problem: Problem, values: Values) -> SparsityPattern:
        """That of a problem, copied: the problem's index tensors may change afterwards."""
        slots = {
            name: tuple((slot, block.clone()) for slot, block in term.slots)
            for name, term in problem.terms.items()
        }
        return cls(_sizes(problem, values), slots)

    def is_of(self, problem: Problem, values: Values) -> bool:
        """Whether a problem has it, whatever tensors its slots are."""
        return (
            self.is_as_large(problem, values)
            and list(self.slots) == list(problem.terms)
            and all(
                [name for name, _ in slots] == [name for name, _ in problem.terms[term].slots]
                and all(
                    torch.equal(block, other)
                    for (_, block), (_, other) in zip(slots, problem.terms[term].slots, strict=True)
                )
                for term, slots in self.slots.items()
            )
        )

    def is_as_large(self, problem: Problem, values: Values) -> bool:
        """Whether a problem's variables are the same, whatever its terms touch."""
        return self.sizes == _sizes(problem, values)


def _sizes(problem: Problem, values: Values) -> dict[str, tuple[int, int]]:
    return {name: (len(values[name]), kind.tangent_dim) for name, kind in problem.variables.items()}
