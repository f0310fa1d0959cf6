from __future__ import annotations

import pytest
import torch
from small_world import Builder
from torch import Tensor


@pytest.fixture
def build() -> Builder:
    """What makes tables from a few numbers."""
    return Builder()


@pytest.fixture
def row_of_signs() -> Tensor:
    """Centres of twelve signs along a road, 20 m apart, on both sides."""
    k = torch.arange(12, dtype=torch.float64)
    return torch.stack((20 * k, 4 * (-1) ** k, 2.5 + 0.1 * k), dim=-1)
