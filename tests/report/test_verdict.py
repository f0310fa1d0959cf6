"""The verdict: the worst of what is judged, with what most of the missing detections failed at."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.report.summaries import Pruned
from crowdmap_torch.report.verdict import FAIR, GOOD, POOR, judgements, overall


@pytest.fixture(scope="module")
def sound(record: RunRecord) -> RunRecord:
    """A record with nothing to complain of."""
    counts = {f"{kind} detections{end}": 100 for kind in ("sign", "lane") for end in ("", " used")}
    return replace(
        record,
        counts=counts,
        rejected=(),
        outlier_journeys=(),
        pruned=(),
        residual_px={"adjusted map": torch.full((9,), 0.5)},
    )


def grade(record: RunRecord) -> str:
    return overall(judgements(record))


def test_a_sound_map_is_good(sound: RunRecord):
    assert grade(sound) == GOOD
    assert grade(replace(sound, figures=None)) == GOOD


def test_missing_detections_come_with_what_most_of_them_failed_at(sound: RunRecord):
    lost = (
        Pruned("sign detections", "in a track: too far away", 50),
        Pruned("sign detections", "in no track", 20),
        Pruned("lane detections", "in no track", 5),
    )
    for used, expected in ((60, FAIR), (30, POOR)):
        counts = {**sound.counts, "sign detections used": used}
        first = judgements(replace(sound, counts=counts, pruned=lost))[0]
        assert (
            first.grade == expected
            and first.text == f"{used}.0 % of the sign detections are in the map"
        )
        assert first.reason.startswith(
            "Of 70 sign detections that are not, 50 ended 'in a track: too far away': nothing is seen from near"
        )


def test_a_map_without_half_of_the_signs_is_poor(sound: RunRecord, build):
    assert sound.survey is not None
    half = build.hd_map(sound.hd_map.signs[torch.arange(4)])
    found = judgements(replace(sound, hd_map=half, figures=evaluate_map(half, sound.survey)))
    assert found[0].grade == POOR and "4 of 9 observable signs" in found[0].text


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"residual_px": {"adjusted map": torch.full((9,), 2.0)}}, FAIR),
        ({"residual_px": {"adjusted map": torch.full((9,), 9.0)}}, POOR),
        ({"outcome": "out of steps"}, FAIR),
        ({"warnings": (Finding("axes", "odd", "cause", "cure"),)}, FAIR),
        ({"warnings": (Finding("no-lanes", "no lanes", "cause", "cure"),)}, POOR),
    ],
)
def test_each_thing_counts(sound: RunRecord, change: dict, expected: str):
    assert grade(replace(sound, **change)) == expected


def test_journeys_without_a_say_are_counted_with_the_first_reason(record: RunRecord):
    (found,) = (j for j in judgements(record) if "have a say" in j.text)
    assert found.text == "1 of 3 journeys have a say" and found.grade == POOR
    assert found.reason == "c: poses.parquet: row 3: x is NaN"


def test_what_cannot_be_judged_is_not(build):
    bare = RunRecord("bare", build.hd_map(build.signs([[0.0, 0, 2]])))
    assert [j.grade for j in judgements(bare)] == [GOOD]
    assert overall(()) == FAIR


def test_what_explains_two_things_is_said_once(sound: RunRecord, build):
    assert sound.survey is not None
    half = build.hd_map(sound.hd_map.signs[torch.arange(4)])
    lost = (Pruned("sign detections", "in no track", 70),)
    found = judgements(
        replace(
            sound,
            hd_map=half,
            figures=evaluate_map(half, sound.survey),
            counts={**sound.counts, "sign detections used": 30},
            pruned=lost,
        )
    )
    assert [bool(j.reason) for j in found if "sign" in j.text][:2] == [True, False]
