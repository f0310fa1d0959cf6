from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from crowdmap_torch.evaluation.evidence import gather_evidence, read_observable_ids, run_of
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.surveys import read_survey


def test_journeys_in_use_are_those_of_the_map(tiny_folder):
    survey = read_survey(tiny_folder / "survey")
    names = sorted(p.name for p in (tiny_folder / "journeys").iterdir())
    hd_map = replace(read_map(tiny_folder / "survey"), provenance={"journeys": names[1:]})
    evidence = gather_evidence(hd_map, survey, tiny_folder / "survey")
    assert evidence.truth is not None
    assert [t.journey.journey_id for t in evidence.truth.journeys] == names[1:]


def test_a_survey_without_truth_or_journeys_says_what_follows(tiny_folder: Path, tmp_path: Path):
    survey = read_survey(tiny_folder / "survey")
    hd_map = read_map(tiny_folder / "survey")
    bare = gather_evidence(hd_map, survey, tmp_path)
    assert bare.truth is None and bare.landmarks == ()
    assert bare.notes == ("no truth with the survey: every surveyed sign is observable",)
    elsewhere = gather_evidence(hd_map, survey, tiny_folder / "survey", dataset_folder=tmp_path)
    assert elsewhere.truth is None
    assert elsewhere.notes[0].startswith(f"{tmp_path} has no journeys")


def test_a_map_of_journeys_without_truth_is_refused(tiny_folder: Path):
    survey = read_survey(tiny_folder / "survey")
    hd_map = replace(read_map(tiny_folder / "survey"), provenance={"journeys": ["nobody's"]})
    with pytest.raises(InputError, match='no truth of journey "nobody\'s"'):
        gather_evidence(hd_map, survey, tiny_folder / "survey")


def test_a_map_is_of_a_run_if_it_is_its_final_one(tmp_path: Path):
    for name in ("map", "map_clusters"):
        (tmp_path / name).mkdir()
    assert run_of(tmp_path / "map") is None
    (tmp_path / "metrics.json").touch()
    assert run_of(tmp_path / "map") == tmp_path.resolve()
    assert run_of(tmp_path / "map_clusters") is None


@pytest.mark.parametrize("content", ["{}", '{"observable": []}', '{"a": ["x", 3]}'])
def test_observable_signs_are_lists_of_ids(tmp_path: Path, content: str):
    path = tmp_path / "ids.json"
    path.write_text('{"here": ["a", "b"], "there": ["c"], "n": 2}')
    assert read_observable_ids(path) == ("a", "b", "c")
    path.write_text(content)
    with pytest.raises(InputError, match="expected an object with lists of sign ids"):
        read_observable_ids(path)
