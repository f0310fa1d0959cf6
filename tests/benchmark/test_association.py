"""The comparison with the paper runs on a small dataset and counts what a run folder would say."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import pytest
import torch

from crowdmap_torch.benchmark import association
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.tables import Dataset


def test_associations_are_those_of_the_result(tiny: Dataset, tiny_result: MapResult):
    found = association.sign_associations(tiny, tiny_result.associations)
    used = sum(int((a.sign >= 0).sum()) for a in tiny_result.associations)
    assert len(found.row) == used > 0
    for number, (journey, expected) in enumerate(
        zip(tiny.journeys, tiny_result.associations, strict=True)
    ):
        rows = found.journey == number
        shown = torch.full((int(journey.signs.row.max()) + 1,), -1)
        shown[found.row[rows]] = found.landmark[rows]
        assert torch.equal(shown[journey.signs.row], expected.sign)


def test_the_table_has_a_line_for_each_method(
    tiny_folder: Path, capsys: pytest.CaptureFixture[str]
):
    parser = argparse.ArgumentParser()
    association.add_arguments(parser)
    association.run(parser.parse_args([str(tiny_folder), "--methods", "paper2017"]))
    heading, line = capsys.readouterr().out.splitlines()
    assert line.split()[:2] == [tiny_folder.name, "paper2017"]
    assert len(line.split()) == 2 + len(association.COLUMNS)
    assert "duplicates" in heading


def test_a_dataset_without_truth_is_refused(tmp_path: Path, tiny_folder: Path):
    for name in ("rigs", "journeys"):
        shutil.copytree(tiny_folder / name, tmp_path / name)
    (tmp_path / "dataset.json").write_text((tiny_folder / "dataset.json").read_text())
    with pytest.raises(ValueError, match="survey/truth"):
        association.compare(tmp_path)
