from __future__ import annotations

import torch

from crowdmap_torch.geometry.extent import extent


def test_extent_is_what_points_reach_over():
    point = torch.tensor([[-10.0, 5, 0], [1240, 9, 3], [torch.nan, 0, 0]], dtype=torch.float64)
    assert extent(point) == "1,250 x 4 m"
    assert extent(point[:0]) == extent(point[:1]) == "0 x 0 m"
