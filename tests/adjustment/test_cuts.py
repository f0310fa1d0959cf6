"""Where drives are cut."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.adjustment.cuts import cut_at_squares, cut_drives


def along(start, stop, y=20.0, step=1.0):
    """Nodes along a straight from one x to another."""
    count = int(abs(stop - start) / step)
    x = torch.linspace(start, stop, count, dtype=torch.float64)
    return torch.stack((x, torch.full_like(x, y)), dim=1)


def cuts(*drives, width=100.0):
    journey = torch.repeat_interleave(
        torch.arange(len(drives)), torch.tensor([len(d) for d in drives])
    )
    return cut_at_squares(torch.cat(drives), journey, width)


def test_drives_are_cut_at_the_same_places_whichever_way_they_go():
    there, back = along(10.0, 390.0), along(390.0, 10.0, y=25.0)
    found = cuts(there, back)
    x = torch.cat((there, back))[found, 0]
    torch.testing.assert_close(
        x, torch.tensor([100.0, 200, 300, 300, 200, 100]).double(), rtol=0, atol=1.5
    )


def test_a_drive_along_a_border_is_not_cut_to_pieces():
    drive = along(10.0, 90.0, y=100.0)
    drive[:, 1] += 5 * torch.sin(torch.arange(len(drive)).double())
    assert not len(cuts(drive))


def test_a_corner_that_is_cut_off_makes_one_piece():
    # Through the corner of a third square, by less than counts as having gone there.
    t = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None]
    start, end = torch.tensor([[40.0, 95.0]]).double(), torch.tensor([[160.0, 106.0]]).double()
    assert len(cuts(start + t * (end - start))) == 1


def test_every_cut_is_within_a_journey():
    drives = [along(10.0, 390.0), along(110.0, 290.0), along(450.0, 480.0)]
    found, starts = (
        cuts(*drives),
        torch.tensor([0, len(drives[0]), len(drives[0]) + len(drives[1])]),
    )
    assert not torch.isin(found, starts).any()
    assert (found[1:] > found[:-1]).all() and len(found) == 4


def cut_for(unknowns, in_square, *drives, at_cut=9):
    journey = torch.repeat_interleave(
        torch.arange(len(drives)), torch.tensor([len(d) for d in drives])
    )
    return cut_drives(torch.cat(drives), journey, unknowns, in_square, at_cut=at_cut)


@pytest.mark.parametrize(("unknowns", "in_square", "expected"), [(600, 400, 0), (1600, 150, 10)])
def test_stretches_have_about_so_many_unknowns(unknowns, in_square, expected):
    drive = along(0.0, 2000.0)
    assert len(cut_for(unknowns, in_square, drive)) == expected
    assert not len(cut_for(unknowns, 0, drive))


def test_squares_are_halved_while_there_are_few_unknowns_at_cuts():
    drive = along(0.0, 2000.0)
    # To a hundred unknowns in a square where one drive passes, and not at all where forty do.
    assert len(cut_for(3200, 800, drive)) == 31
    many = len(cut_for(3200, 800, *[drive] * 40))
    assert many == 40 * 3
    # So many unknowns that half of the squares' would be too many.
    assert 9 * many <= 0.5 * 3200 < 9 * len(cut_for(6400, 800, *[drive] * 40))


def test_without_nodes_nothing_is_cut():
    none = torch.zeros(0, 2, dtype=torch.float64)
    assert not len(cut_for(10_000, 100, none))
