from __future__ import annotations

import numpy as np
from worlds.marked_roads import bend, line

from crowdmap_torch.io.formats.exporters.lane_chains import chains


def test_pieces_that_meet_are_one_chain_whatever_their_direction():
    pieces = [line((0, 0), (50, 0)), line((100, 0), (50.4, 0)), line((101, 0), (150, 0))]
    (chain,), stubs = chains(pieces)
    assert stubs == []
    assert [*dict.fromkeys(chain.piece.tolist())] == [0, 1, 2]
    assert (np.diff(chain.point_world[:, 0]) > 0).all()
    assert chain.piece[chain.joints + 1].tolist() == [1, 2]
    assert chain.joints.tolist() == [50, 50 + len(pieces[1])]


def test_every_point_is_in_a_chain_or_a_stub():
    pieces = [line((0, 0), (50, 0)), line((49.2, 0), (100, 0)), line((0, 9), (5, 9))]
    found, stubs = chains(pieces)
    assert len(found) == 2
    ((number, stub),) = stubs
    assert number == 1 and len(stub) >= 2
    nodes = {n for chain in found for n in chain.node.tolist()} | {*stub.tolist()}
    assert nodes == {*range(sum(map(len, pieces)))}
    # What overlaps does not run back.
    assert all((np.diff(chain.point_world[:, 0]) > 0).all() for chain in found)


def test_lines_beside_or_across_one_another_are_not_joined():
    pieces = [line((0, 0), (50, 0)), line((50.5, 1), (90, 1)), line((50.5, 0), (50.5, -40))]
    assert len(chains(pieces)[0]) == 3
    bridge = line((51, 0), (90, 0), z=5.0)
    assert len(chains([pieces[0], bridge])[0]) == 2


def test_a_ring_ends_where_it_begins():
    half = bend(30, 180, 0)
    other = np.column_stack((-half[:, 0], 60 - half[:, 1], half[::-1, 2]))
    half[:, 2] = other[:, 2] = 0
    (chain,), _ = chains([half, other])
    assert chain.node[0] == chain.node[-1]
    assert len(chain) == len(half) + len(other) + 1


def test_no_pieces_are_no_chains():
    assert chains([]) == ([], [])
