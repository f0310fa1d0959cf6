from __future__ import annotations

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.formats.composing.outlines import clockwise, corner_count, in_box


@pytest.mark.parametrize("shape", range(len(polygon.SHAPES)), ids=polygon.SHAPES)
def test_a_shape_fills_its_box_clockwise(shape: int):
    corners = in_box(shape, np.array([10.0, 20.0, 30.0, 60.0]))
    np.testing.assert_allclose((corners.min(0), corners.max(0)), ((10, 20), (40, 80)))
    index = torch.tensor([shape])
    mask = polygon.corner_mask(index)
    assert float(polygon.signed_area(torch.from_numpy(corners)[None], mask)) > 0
    # The first of FORMAT.md's corners is at the top.
    assert corners[0, 1] == 20


def test_corners_are_turned_to_run_clockwise():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    for given in (square, square[::-1]):
        found = clockwise(given)
        assert found.shape == (8, 2)
        assert sorted(map(tuple, found[:4].tolist())) == sorted(map(tuple, square.tolist()))
        u, v = found[:4].T
        assert (u * np.roll(v, -1) - np.roll(u, -1) * v).sum() > 0
        assert (found[4:] == found[3]).all()


def test_corners_are_counted_as_the_shapes_have_them():
    assert [corner_count(k) for k in range(6)] == polygon.CORNER_COUNT.tolist()
