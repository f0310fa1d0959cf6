from __future__ import annotations

import math
from dataclasses import replace

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


@pytest.mark.parametrize("spread", [1.0, 300.0])
@pytest.mark.parametrize("n", [2, 3, 8])
def test_few_signs_of_an_honest_map_are_judged_like_many(build, n: int, spread: float):
    # The last sign's variance is smaller by `spread`: less the shared part it is next to nothing.
    generator = torch.Generator().manual_seed(n)
    draws = 150
    k = torch.arange(n, dtype=torch.float64)
    true = build.signs(torch.stack((30 * k, 0 * k, 0 * k + 2), dim=-1))
    A = torch.randn(n, 3, 3, generator=generator, dtype=torch.float64) / 3
    own = 1e-2 * (A @ A.mT + torch.eye(3)) * spread ** -(k / (n - 1))[:, None, None]
    in_mean = torch.linalg.inv(torch.linalg.inv(own).sum(0))
    for_all = 0.09 * torch.diag(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    shared = for_all + in_mean
    signs = replace(true, covariance=own + for_all)
    noise = torch.randn(draws, n + 1, 3, 1, generator=generator, dtype=torch.float64)
    error = torch.linalg.cholesky(own) @ noise[:, :n] + for_all.sqrt() @ noise[:, n:]
    comparison, found = compare_signs(signs, build.survey_signs(true)), []
    for drawn in error[..., 0]:
        moved = replace(comparison, center_error_world=drawn[:, None])
        found.append(evaluate_uncertainty(moved, signs, shared))
    nees, shift, inside = (
        torch.tensor([getattr(f, name) for f in found])
        for name in ("mean_nees", "shared_nees", "coverage")
    )
    # Chi-squared over `draws` with 3 (n - 1) and 3 degrees of freedom, four standard deviations.
    assert float(nees.mean()) == pytest.approx(3, abs=4 * (6 / (n - 1) / draws) ** 0.5)
    assert float(shift.mean()) == pytest.approx(3, abs=4 * (6 / draws) ** 0.5)
    assert float(inside.mean()) == pytest.approx(0.95, abs=4 * (0.05 / (n - 1) / draws) ** 0.5)


def test_a_single_sign_is_its_own_mean(build):
    figures = figures_of(build, own=0.1, shared=0.3, n=1)
    assert math.isnan(figures.coverage) and math.isnan(figures.mean_nees)
    assert figures.shared_nees >= 0


def test_an_empty_map_has_no_figure(build):
    nothing = build.signs(torch.zeros(0, 3, dtype=torch.float64))
    comparison = compare_signs(nothing, build.survey_signs(nothing))
    figures = evaluate_uncertainty(comparison, nothing, torch.zeros(3, 3, dtype=torch.float64))
    assert figures.signs == 0
    assert math.isnan(figures.coverage)
