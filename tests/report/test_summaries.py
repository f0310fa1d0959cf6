from __future__ import annotations

import torch

from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.runs.metrics import journey_summaries
from crowdmap_torch.tables import Dataset


def test_biases_stand_beside_the_true_ones(
    tiny: Dataset, tiny_result: MapResult, tiny_truth: Truth
):
    summaries = journey_summaries(tiny, tiny_result, tiny_truth)
    found = torch.tensor([s.bias for s in summaries])
    true = torch.tensor([s.true_bias for s in summaries])
    # What all journeys share nobody can tell; what is left agrees to centimetres.
    left = (found - true) - (found - true).mean(0)
    assert left.abs().max() < 0.1 < true.abs().max()
    assert all(s.true_bias is None for s in journey_summaries(tiny, tiny_result))
