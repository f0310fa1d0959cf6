from __future__ import annotations

from crowdmap_torch.studies import paper, preset


def test_the_preset_is_asked_to_land_where_the_paper_did():
    low, high = preset.ABSOLUTE_M
    assert low <= paper.ABSOLUTE_M <= high
    low, high = preset.RELATIVE_M
    assert low <= paper.RELATIVE_M <= high
