"""The order in which chains of blocks are eliminated: nested dissection, worked out once per problem.

Blocks of the eliminated variable form chains (the frames of a journey). Each may carry a leaf, a block of a second
variable that is bound to it alone (the frame's own pose, where the chain is its slow drift): leaves go first. A chain
is cut into tiles of `tile_size` interior blocks and one separator; the interiors are eliminated, the separators are
the chain of the next level, and so on until no block is left. Tiles that see the same landmarks (the same stretch of
road, driven by anybody) form a group with one window of columns, so that the products of a whole group are one matrix
product and nothing is padded to the widest of all.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee
from torch import Tensor

from crowdmap_torch.optim.linear import Layout, layout
from crowdmap_torch.optim.problem import CostTerm, Problem, Values


@dataclass(frozen=True)
class Coupling:
    """A term between the eliminated blocks and the landmarks, its rows sorted by (block, landmarks) pair."""

    order: Int[Tensor, " m"]
    """Rows of the term, in the order of their factors."""
    factor_of_row: Int[Tensor, " m"]
    """Rows of one eliminated block and the same landmarks add up to one factor."""
    block: Int[Tensor, " f"]
    """Eliminated block of each factor, counted over leaves and chain."""
    column: Int[Tensor, "f k"]
    """Columns of the reduced system that the factor touches."""
    eliminated_slot: int


@dataclass(frozen=True)
class FactorPart:
    """The factors of one coupling that belong to one group, and where they go in its window."""

    coupling: str
    factor: Int[Tensor, " f"]
    row: Int[Tensor, " f"]
    """Interior block (tile of the group times slots plus slot)."""
    position: Int[Tensor, "f k"]
    """Column within the group's window."""


@dataclass(frozen=True)
class FillPart:
    """Fill-in from a level below: what one of its groups left on separators that are interior here."""

    level: int
    group: int
    tile: Int[Tensor, " t"]
    right: bool
    """Whether the separator is the right or the left one of those tiles."""
    row: Int[Tensor, " t"]
    position: Int[Tensor, " w"]
    """Where that group's columns stand in this window."""


@dataclass(frozen=True)
class Group:
    """Tiles that are eliminated together."""

    node: Int[Tensor, "t s"]
    """Block of each interior slot at this level; -1 for none."""
    left: Int[Tensor, " t"]
    """Separator before each tile, a block of the next level; -1 for none."""
    right: Int[Tensor, " t"]
    columns: Int[Tensor, " w"]
    """The window: columns of the reduced system."""
    factors: tuple[FactorPart, ...]
    fills: tuple[FillPart, ...]


@dataclass(frozen=True)
class Level:
    """One round of elimination."""

    block_of_node: Int[Tensor, " n"]
    """Which block of the eliminated variable each node is."""
    groups: tuple[Group, ...]
    kept: Int[Tensor, " next"]
    """Nodes that are the nodes of the next level, in order."""
    keeps_links: bool
    """Whether the kept nodes are linked to each other already: true where only leaves go."""


@dataclass(frozen=True)
class ChainStructure:
    """Everything about the elimination that does not depend on values."""

    where: Layout
    """The reduced system: all variables but the eliminated one."""
    couplings: dict[str, Coupling]
    chain_terms: tuple[str, ...]
    """Terms among the eliminated blocks alone."""
    landmark_terms: tuple[str, ...]
    levels: tuple[Level, ...]
    base: dict[str, int]
    """First block of the leaves and of the chain, counted over both."""
    chain: Int[Tensor, " n"]
    """Chain of each block, counted over both; -1 for leaves."""
    carrier: Int[Tensor, " m"]
    """Block of the chain that carries each leaf."""


def analyse(
    problem: Problem,
    values: Values,
    eliminate: str,
    chain: Int[Tensor, " n"],
    *,
    leaves: str | None = None,
    carrier: Int[Tensor, " m"] | None = None,
    tile_size: int,
    group_tiles: int,
) -> ChainStructure:
    """The elimination of `eliminate`, whose blocks lie chain by chain, in order, and of the `leaves` on them.

    Every row may touch one eliminated block and any landmarks, or one or two eliminated blocks: neighbours of a
    chain, or a leaf and the block that carries it.
    """
    leaf_count = 0 if carrier is None else len(carrier)
    base = {eliminate: 0} if leaves is None else {leaves: 0, eliminate: leaf_count}
    where = layout(problem, values, skip=tuple(base))
    couplings, chain_terms, landmark_terms = {}, [], []
    for name, term in problem.terms.items():
        eliminated = [i for i, (slot, _) in enumerate(term.slots) if slot in base]
        if len(eliminated) == len(term.slots):
            chain_terms.append(name)
        elif not eliminated:
            landmark_terms.append(name)
        elif len(eliminated) == 1:
            couplings[name] = _coupling(problem, term, eliminated[0], where, base)
        else:
            raise ValueError(
                f"term {name!r} couples {len(eliminated)} eliminated blocks with other variables; "
                "at most one is supported"
            )
    carrier = chain[:0] if carrier is None else carrier
    chain = torch.cat((torch.full_like(carrier, -1), chain))
    levels = _levels(couplings, chain, carrier, where.dim, tile_size, group_tiles)
    return ChainStructure(
        where, couplings, tuple(chain_terms), tuple(landmark_terms), levels, base, chain, carrier
    )


def _coupling(
    problem: Problem, term: CostTerm, slot: int, where: Layout, base: dict[str, int]
) -> Coupling:
    name, block = term.slots[slot]
    block = block + base[name]
    landmarks = [
        (where.offset[name][index], problem.variables[name].tangent_dim)
        for i, (name, index) in enumerate(term.slots)
        if i != slot
    ]
    # One number for the landmarks of a row: their first columns in mixed radix, hashed down by `unique`.
    key = block
    for start, _ in landmarks:
        _, key = torch.unique(key * (where.dim + 1) + start, return_inverse=True)
    order = torch.argsort(key, stable=True)
    _, factor_of_row = torch.unique_consecutive(key[order], return_inverse=True)
    count = int(factor_of_row[-1]) + 1 if len(order) else 0
    first = torch.zeros(count, dtype=torch.long, device=block.device)
    first[factor_of_row.flip(0)] = order.flip(0)
    column = torch.cat(
        [
            start[first][:, None] + torch.arange(dim, device=block.device)
            for start, dim in landmarks
        ],
        dim=-1,
    )
    return Coupling(order, factor_of_row, block[first], column, slot)


def _levels(
    couplings: dict[str, Coupling],
    chain: Int[Tensor, " n"],
    carrier: Int[Tensor, " m"],
    dim: int,
    tile_size: int,
    group_tiles: int,
) -> tuple[Level, ...]:
    device = chain.device
    pairs = [
        torch.stack((c.block[:, None].expand_as(c.column), c.column), dim=-1).reshape(-1, 2)
        for c in couplings.values()
    ]
    pairs = torch.cat(pairs) if pairs else torch.zeros(0, 2, dtype=torch.long, device=device)
    keys = torch.unique(pairs[:, 0] * max(dim, 1) + pairs[:, 1])
    rank = _column_rank(keys, len(chain), dim, tile_size)

    chain_count = len(torch.unique(chain[chain >= 0]))
    levels: list[Level] = []
    block_of_node = torch.arange(len(chain), device=device)
    # Factors that are not yet placed, by coupling; each belongs to the node of its block.
    node_of_block = torch.arange(len(chain), device=device)
    pending = {name: torch.arange(len(c.block), device=device) for name, c in couplings.items()}
    while len(chain):
        leaf = chain < 0
        cut = (
            _leaf_tiles(carrier, len(chain)) if bool(leaf.any()) else _chain_tiles(chain, tile_size)
        )
        tile, slot, interior, left, right = cut.tile, cut.slot, cut.interior, cut.left, cut.right
        kept = torch.nonzero(~interior)[:, 0]
        tile_count = len(left)
        slots = cut.slots
        next_of = torch.full_like(chain, -1)
        next_of[kept] = torch.arange(len(kept), device=device)
        node = torch.full((tile_count, slots), -1, device=device)
        inside = torch.nonzero(interior)[:, 0]
        node[tile[inside], slot[inside]] = inside

        key_node, key_column = keys // max(dim, 1), keys % max(dim, 1)
        in_tile = interior[key_node]
        tile_keys = torch.unique(tile[key_node[in_tile]] * max(dim, 1) + key_column[in_tile])
        # Leaves of one place come by the dozen; the tiles of a chain about once a chain. More would widen the window.
        size = group_tiles if bool(leaf.any()) else min(group_tiles, max(4, chain_count // 3))
        groups = _groups(
            tile_keys // max(dim, 1), tile_keys % max(dim, 1), rank, dim, tile_count, size
        )
        group_of_tile = torch.full((tile_count,), -1, device=device)
        tile_in_group = torch.full((tile_count,), -1, device=device)
        for g, (members, _) in enumerate(groups):
            group_of_tile[members] = g
            tile_in_group[members] = torch.arange(len(members), device=device)

        placed = {name: node_of_block[couplings[name].block[f]] for name, f in pending.items()}
        by_group = {
            name: _split(torch.where(interior[at], group_of_tile[tile[at]], -1), len(groups))
            for name, at in placed.items()
        }
        place = _Place(node_of_block, interior, group_of_tile, tile_in_group, tile, slot)
        fills_of = _fills(levels, place, slots, len(groups))
        built = []
        for g, (members, columns) in enumerate(groups):
            where_in = torch.full((max(dim, 1),), -1, device=device)
            where_in[columns] = torch.arange(len(columns), device=device)
            factors = []
            for name, factor in pending.items():
                mine = by_group[name][g]
                if len(mine):
                    at = placed[name][mine]
                    row = tile_in_group[tile[at]] * slots + slot[at]
                    columns_of = couplings[name].column[factor[mine]]
                    factors.append(FactorPart(name, factor[mine], row, where_in[columns_of]))
            fills = [
                FillPart(*fill, where_in[levels[fill[0]].groups[fill[1]].columns])
                for fill in fills_of[g]
            ]
            built.append(
                Group(
                    node[members],
                    left[members],
                    right[members],
                    columns,
                    tuple(factors),
                    tuple(fills),
                )
            )
        levels.append(Level(block_of_node, tuple(built), kept, bool(leaf.any())))

        pending = {name: factor[~interior[placed[name]]] for name, factor in pending.items()}
        tile_of_key = tile_keys // max(dim, 1)
        column_of_key = tile_keys % max(dim, 1)
        separators = [next_of[key_node[~in_tile]] * max(dim, 1) + key_column[~in_tile]]
        for side in (left, right):
            has = side[tile_of_key] >= 0
            separators.append(side[tile_of_key[has]] * max(dim, 1) + column_of_key[has])
        keys = torch.unique(torch.cat(separators))
        node_of_block = torch.full_like(node_of_block, -1)
        block_of_node = block_of_node[kept]
        node_of_block[block_of_node] = torch.arange(len(kept), device=device)
        chain = chain[kept]
    return tuple(levels)


def _split(label: Int[Tensor, " n"], count: int) -> tuple[Tensor, ...]:
    """The rows of every label from 0 to `count - 1`; rows of label -1 are left out."""
    order = torch.argsort(label, stable=True)
    sizes = torch.bincount(label + 1, minlength=count + 1).tolist()
    return order.split(sizes)[1:]


@dataclass(frozen=True)
class _Tiles:
    """How the nodes of a level are cut."""

    tile: Tensor
    slot: Tensor
    interior: Tensor
    left: Tensor
    right: Tensor
    slots: int


def _chain_tiles(chain: Int[Tensor, " n"], tile_size: int) -> _Tiles:
    """Tiles of `tile_size` interior nodes and the separator behind them."""
    n = len(chain)
    index = torch.arange(n, device=chain.device)
    first = torch.ones(n, dtype=torch.bool, device=chain.device)
    first[1:] = chain[1:] != chain[:-1]
    position = index - index[first][first.cumsum(0) - 1]
    slot = position % (tile_size + 1)
    tile = (first | (slot == 0)).cumsum(0) - 1
    interior = slot < tile_size
    separator = torch.nonzero(~interior)[:, 0]
    next_of = torch.arange(len(separator), device=chain.device)
    left = torch.full((int(tile[-1]) + 1,), -1, device=chain.device)
    right = left.clone()
    right[tile[separator]] = next_of
    # The separator before a tile is the last node of the tile before it, in the same chain.
    follows = ~torch.cat((first[1:], first.new_ones(1)))[separator]
    left[tile[separator[follows] + 1]] = next_of[follows]
    return _Tiles(tile, slot, interior, left, right, tile_size)


def _leaf_tiles(carrier: Int[Tensor, " m"], count: int) -> _Tiles:
    """Tiles of one leaf each, its separator the chain's block that carries it."""
    leaves = len(carrier)
    tile = torch.zeros(count, dtype=torch.long, device=carrier.device)
    tile[:leaves] = torch.arange(leaves, device=carrier.device)
    interior = torch.arange(count, device=carrier.device) < leaves
    return _Tiles(tile, torch.zeros_like(tile), interior, torch.full_like(carrier, -1), carrier, 1)


@dataclass(frozen=True)
class _Place:
    """Where the nodes of the level that is being built lie."""

    node_of_block: Tensor
    interior: Tensor
    group_of_tile: Tensor
    tile_in_group: Tensor
    tile: Tensor
    slot: Tensor


def _fills(
    levels: list[Level], place: _Place, slots: int, count: int
) -> list[list[tuple[int, int, Tensor, bool, Tensor]]]:
    """What all levels below left on the separators that each group eliminates: level, group, tiles, side, rows.

    A separator may stay one for several levels: its fill-in waits with the group that made it.
    """
    fills: list[list[tuple[int, int, Tensor, bool, Tensor]]] = [[] for _ in range(count)]
    for number, level in enumerate(levels):
        # Blocks that are eliminated by now have node -1; their fill-in has been used.
        node = place.node_of_block[level.block_of_node[level.kept]]
        is_here = (node >= 0) & place.interior[node]
        tile = place.tile[node]
        row = torch.where(is_here, place.tile_in_group[tile] * slots + place.slot[node], -1)
        group_of = torch.where(is_here, place.group_of_tile[tile], -1)
        for b, group in enumerate(level.groups):
            for is_right, side in ((False, group.left), (True, group.right)):
                index = torch.nonzero(side >= 0)[:, 0]
                to_group = group_of[side[index]]
                for g in torch.unique(to_group).tolist():
                    if g >= 0:
                        of_group = index[to_group == g]
                        fills[g].append((number, b, of_group, is_right, row[side[of_group]]))
    return fills


def _groups(
    key_tile: Tensor,
    key_column: Tensor,
    rank: Tensor,
    dim: int,
    tile_count: int,
    group_tiles: int,
) -> list[tuple[Tensor, Tensor]]:
    """Tiles in the order of their windows, cut into runs; with each run the union of its windows."""
    count = torch.bincount(key_tile, minlength=tile_count)
    total = torch.zeros(tile_count, dtype=torch.float64, device=key_tile.device)
    total.index_add_(0, key_tile, rank[key_column].to(total) if dim else total[:0])
    # Frames that see lanes have windows several times as wide as those that see signs alone: keep the two apart.
    position = total / count.clamp_min(1)
    wide = count > count.to(total).mean()
    order = torch.argsort(position + wide * (len(rank) + 1), stable=True)
    group_of_tile = torch.empty_like(order)
    group_of_tile[order] = torch.arange(tile_count, device=order.device) // group_tiles
    members = order.split(group_tiles)
    columns = torch.unique(group_of_tile[key_tile] * max(dim, 1) + key_column)
    sizes = torch.bincount(columns // max(dim, 1), minlength=len(members)).tolist()
    return list(zip(members, (columns % max(dim, 1)).split(sizes), strict=True))


def _column_rank(keys: Tensor, n: int, dim: int, tile_size: int) -> Tensor:
    """A position of every column on a line, such that columns seen together are near each other."""
    if not dim:
        return torch.zeros(0, dtype=torch.long, device=keys.device)
    tile, column = (keys // dim // (tile_size + 1)).cpu().numpy(), (keys % dim).cpu().numpy()
    seen = coo_matrix((torch.ones(len(tile)).numpy(), (tile, column)), shape=(n, dim)).tocsr()
    order = reverse_cuthill_mckee((seen.T @ seen).tocsr(), symmetric_mode=True)
    rank = torch.empty(dim, dtype=torch.long)
    rank[torch.from_numpy(order.astype("int64"))] = torch.arange(dim)
    return rank.to(keys.device)
