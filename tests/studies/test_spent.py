from __future__ import annotations

import torch

from crowdmap_torch.studies.spent import spent


def test_the_peak_is_that_of_the_stage():
    stages: dict[str, dict[str, float]] = {}
    with spent(stages, "large"):
        large = torch.ones(30_000_000)
        del large
    with spent(stages, "small"):
        total = float(torch.ones(1000).sum())
    assert total == 1000 and stages["small"]["seconds"] < 5
    # 120 MB are held in the first alone.
    assert stages["large"]["peak_mb"] - stages["small"]["peak_mb"] > 80
