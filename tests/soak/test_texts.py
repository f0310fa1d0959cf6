"""Texts are changed whatever they hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crowdmap_torch.soak import texts
from crowdmap_torch.soak.texts import mutate_document


def test_a_text_that_no_reader_can_read_is_changed_as_text(tmp_path: Path) -> None:
    # A level within a level, more than Python can follow.
    path, deep = tmp_path / "config.yaml", "[" * 3000
    path.write_text(deep)
    assert mutate_document(path, np.random.default_rng(0))
    assert path.read_bytes() != deep.encode()


@pytest.mark.parametrize("name", ["config.yaml", "journey.json"])
def test_what_is_nested_to_the_reader_s_limit_is_changed_all_the_same(
    tmp_path: Path, name: str
) -> None:
    depth = 600 if name.endswith("json") else 150
    path, deep = tmp_path / name, "[" * depth + "]" * depth
    for seed in range(12):
        path.write_text(deep)
        assert mutate_document(path, np.random.default_rng(seed))
        assert path.exists()


def test_what_stands_in_many_places_is_one_place() -> None:
    shared: list = [1, 2]
    for _ in range(40):
        shared = [shared, shared]
    assert len(list(texts._places(shared))) == 82


@pytest.mark.parametrize("name", ["merge bomb", "alias bomb"])
def test_a_bomb_that_is_there_already_does_not_go_off(tmp_path: Path, name: str) -> None:
    path = tmp_path / "rig.yaml"
    for seed in range(6):
        path.write_text(texts.BOMBS[name])
        assert mutate_document(path, np.random.default_rng(seed))
