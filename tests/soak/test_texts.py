"""Texts are changed whatever they hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crowdmap_torch.soak.texts import mutate_document


def test_a_text_that_no_reader_can_read_is_changed_as_text(tmp_path: Path) -> None:
    # A level within a level, more than Python can follow.
    path, deep = tmp_path / "config.yaml", "[" * 3000
    path.write_text(deep)
    assert mutate_document(path, np.random.default_rng(0))
    assert path.read_bytes() != deep.encode()
