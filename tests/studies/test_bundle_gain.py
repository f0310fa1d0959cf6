from __future__ import annotations

import pytest
from worlds.studied import fill, rows, work

from crowdmap_torch.studies import bundle_gain
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings


def test_the_gain_is_the_share_that_adjustment_takes_off_the_heads(
    settings: Settings, folder: StudyFolder
):
    fill(folder, work(bundle_gain, settings))
    (table,) = bundle_gain.chapter(settings, folder).tables
    assert [row[:2] for row in rows(table)] == [
        (method, error) for method in ("ours", "paper2017") for error in ("relative", "absolute")
    ]
    for _, _, heads, adjusted, gain, least, most, seeds in rows(table):
        assert gain == pytest.approx(1 - adjusted / heads) == pytest.approx(0.5)
        assert least == pytest.approx(most)
        assert seeds == 2


def test_the_papers_maps_are_adjusted_too(settings: Settings):
    papers = [t for t in work(bundle_gain, settings) if t.config.method == "paper2017"]
    assert papers and all(task.adjusted for task in papers)
