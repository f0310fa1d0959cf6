from __future__ import annotations

import json
import math
from dataclasses import replace

from crowdmap_torch.evaluation.evaluate import evaluate_map


def test_figures_are_json_without_the_comparison_and_with_null_for_what_is_unknown(
    build, row_of_signs
):
    signs = build.signs(row_of_signs)
    figures = evaluate_map(build.hd_map(signs), build.survey(signs, []))
    assert figures.comparison is not None and math.isnan(figures.absolute_over_oracle)
    told = figures.as_dict()
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert "comparison" not in told
    assert told["absolute_over_oracle"] is None and told["lanes"] is None
    assert told["signs"]["recall"] == 1
    # What is told is a copy: the figures keep what they were made from.
    assert replace(figures).comparison is figures.comparison
