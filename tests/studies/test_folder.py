from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.studies.folder import StudyFolder, dataset_name, digest, journey_config_hash


def test_a_digest_follows_the_content_and_not_its_order():
    assert digest({"a": 1, "b": [2.5]}) == digest({"b": [2.5], "a": 1})
    assert digest({"a": 1}) != digest({"a": 2})
    assert len(digest({})) == 12


def test_a_dataset_has_a_name_of_its_settings(folder: StudyFolder):
    first = SimulationConfig()
    assert dataset_name(first) == dataset_name(SimulationConfig())
    others = [replace(first, seed=1), replace(first, journeys=3), replace(first, world_seed=5)]
    names = {folder.dataset(each).name for each in (first, *others)}
    assert len(names) == 4 and all(name.startswith("suburb-") for name in names)


def test_single_journeys_share_maps_whatever_comes_after_them():
    default = MapperConfig()
    after = replace(default, adjust=replace(default.adjust, tukey_c=9.0), min_confidence=0.9)
    before = replace(default, road=replace(default.road, method="calibration"))
    assert journey_config_hash(default) == journey_config_hash(after)
    assert journey_config_hash(default) != journey_config_hash(before)
    # The paper's method decides of single journeys too.
    assert journey_config_hash(default) != journey_config_hash(MapperConfig(method="paper2017"))


def test_a_result_is_there_as_a_whole_or_not_at_all(folder: StudyFolder):
    with pytest.raises(ValueError):
        folder.write_result("broken", {"unknown": float("nan")})
    assert not folder.has_result("broken")
    folder.write_result("whole", {"error": 0.5})
    assert folder.read_result("whole") == {"error": 0.5}
    assert [p.name for p in (folder.path / "results").iterdir()] == ["whole.json"]
    assert json.loads((folder.path / "results" / "whole.json").read_text()) == {"error": 0.5}


def test_a_file_is_no_study_folder(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file"):
        StudyFolder(tmp_path / "file")
