from __future__ import annotations

import math

import pytest
import torch

from crowdmap_torch.evaluation.statistics import error_figures


def test_figures_leave_out_what_is_unknown():
    figures = error_figures(torch.tensor([0.1, torch.nan, 0.3, torch.inf, 0.2]))
    assert figures.count == 3
    assert figures.mean == pytest.approx(0.2)
    assert figures.median == pytest.approx(0.2)
    assert figures.p95 == pytest.approx(0.29)
    assert figures.std == pytest.approx(math.sqrt(2 / 300))


def test_nothing_known_is_no_number():
    figures = error_figures(torch.zeros(0))
    assert figures.count == 0
    assert math.isnan(figures.mean) and math.isnan(figures.std)
