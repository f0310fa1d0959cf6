from __future__ import annotations

import math

import pytest
import torch

from crowdmap_torch.evaluation.signs import compare_signs
from crowdmap_torch.evaluation.uncertainty import evaluate_uncertainty


def figures_of(build, *, own: float, shared: float, claimed: float | None = None, n: int = 400):
    """A map whose errors have the sigmas `own` and `shared`, and claims `claimed` for `own`."""
    generator = torch.Generator().manual_seed(7)
    k = torch.arange(n, dtype=torch.float64)
    true = build.signs(torch.stack((30 * k, 0 * k, 0 * k + 2), dim=-1))
    noise = own * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    noise += shared * torch.randn(1, 3, generator=generator, dtype=torch.float64)
    sigma = math.hypot(claimed or own, shared)
    signs = build.signs(true.center_world + noise, sigma=sigma)
    comparison = compare_signs(signs, build.survey_signs(true))
    eye = torch.eye(3, dtype=torch.float64)
    return evaluate_uncertainty(comparison, signs, shared**2 * eye)


def test_an_honest_map_covers_95_percent(build):
    figures = figures_of(build, own=0.1, shared=0.3)
    assert figures.signs == 400
    # Binomial: 95 % of 400 with a standard deviation of 1.1 %.
    assert figures.coverage == pytest.approx(0.95, abs=0.033)
    assert figures.mean_nees == pytest.approx(3, abs=3 * (6 / 400) ** 0.5)
    assert 0.2 < figures.shared_nees < 9.4


def test_a_map_too_sure_of_itself_is_found_out(build):
    figures = figures_of(build, own=0.1, shared=0.3, claimed=0.05)
    assert figures.coverage < 0.7
    assert figures.mean_nees > 9


def test_without_a_shared_part_the_shift_has_no_figure(build):
    assert math.isnan(figures_of(build, own=0.1, shared=0.0, n=20).shared_nees)


def test_an_empty_map_has_no_figure(build):
    nothing = build.signs(torch.zeros(0, 3, dtype=torch.float64))
    comparison = compare_signs(nothing, build.survey_signs(nothing))
    figures = evaluate_uncertainty(comparison, nothing, torch.zeros(3, 3, dtype=torch.float64))
    assert figures.signs == 0
    assert math.isnan(figures.coverage)
