from __future__ import annotations

import math

import numpy as np
import pytest

from crowdmap_torch.studies.journeys import statistical_bound
from crowdmap_torch.studies.numbers import number, pooled_std, seconds, spread


def errors(values: np.ndarray) -> dict:
    return {"mean": float(values.mean()), "std": float(values.std()), "count": len(values)}


def test_a_number_that_is_not_there_is_unknown():
    result = {"map": {"signs": {"recall": 0.9, "precision": None}, "lanes": None}}
    assert number(result, "map.signs.recall") == 0.9
    for path in ("map.signs.precision", "map.lanes.recall", "heads.signs.recall"):
        assert math.isnan(number(result, path))


def test_spread_is_over_what_is_known():
    found = spread([0.1, math.nan, 0.3])
    assert (found.mean, found.low, found.high, found.count) == (0.2, 0.1, 0.3, 2)
    assert found.std == pytest.approx(0.1)
    assert math.isnan(spread([math.nan]).mean)


def test_the_pooled_spread_is_that_of_all_signs_together():
    rng = np.random.default_rng(0)
    first, second = rng.normal(0.2, 0.05, 40), rng.normal(0.4, 0.1, 10)
    found = [{"map": {"error": errors(first)}}, {"map": {"error": errors(second)}}, {}]
    assert pooled_std(found, "map.error") == pytest.approx(np.concatenate((first, second)).std())
    assert math.isnan(pooled_std([{}], "map.error"))


def test_the_statistical_bound_falls_with_the_root_down_to_what_all_share():
    alone = [{"signs": {"absolute": {"total": {"mean": value}}}} for value in (0.4, 0.6)]
    bound = [statistical_bound(alone, "absolute.total", n, 0.0) for n in (1, 4, 25)]
    assert bound == pytest.approx([0.5, 0.25, 0.1])
    assert statistical_bound(alone, "absolute.total", 10**8, 0.17) == pytest.approx(0.17, abs=1e-6)


def test_seconds_are_those_of_all_stages():
    assert seconds([{"seconds": 1.5}, {"seconds": {"heads": 1.0, "adjusted": 2.0}}]) == 4.5
