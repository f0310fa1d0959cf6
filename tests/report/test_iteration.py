from __future__ import annotations

from crowdmap_torch.report.iteration import Iteration


def test_the_total_is_the_sum_of_all_terms():
    step = Iteration(1, {"sign_reprojection": 2.0, "lane": 0.5}, 1e-4, 0.9, 0.1)
    assert step.total == 2.5
    assert Iteration(0, {}, 1e-4, 0.0, 0.0).total == 0
