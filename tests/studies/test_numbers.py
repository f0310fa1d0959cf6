from __future__ import annotations

import math

import numpy as np
import pytest

from crowdmap_torch.studies.numbers import (
    number,
    pooled_std,
    seconds,
    spread,
    spreads,
    weighted_mean,
)


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


def test_seconds_are_those_of_all_stages():
    assert seconds([{"seconds": 1.5}, {"seconds": {"heads": 1.0, "adjusted": 2.0}}]) == 4.5


def test_spreads_have_their_titles_and_bars_are_mean_and_sigma():
    found = [{"a": {"b": value}} for value in (1.0, 3.0)]
    row = spreads(found, {"title": "a.b", "missing": "a.c"})
    assert row["title"].bar == (2.0, 1.0)
    assert row["missing"].count == 0


def test_values_that_count_more_draw_the_mean_to_them():
    assert weighted_mean([1.0, 4.0], [2.0, 1.0]) == 2.0
    assert math.isnan(weighted_mean([], []))
    # A map with one sign has no figure of how sure its signs are of one another.
    assert weighted_mean([1.0, math.nan, 4.0], [2.0, 1.0, 1.0]) == 2.0
    assert math.isnan(weighted_mean([math.nan], [1.0]))
