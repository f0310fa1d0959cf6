from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.sign_outcomes import (
    NamedOutcomes,
    SignOutcomes,
    read_sign_outcomes,
    write_sign_outcomes,
)


@pytest.fixture
def outcomes() -> NamedOutcomes:
    shape = torch.tensor([polygon.SHAPES.index(n) for n in ("triangle", "rectangle", "octagon")])
    corners = torch.arange(48, dtype=torch.float64).reshape(3, 8, 2)
    mask = polygon.corner_mask(shape)
    last = (mask.sum(1) - 1)[:, None, None].expand(-1, 8, 2)
    corners = torch.where(mask[..., None], corners, corners.gather(1, last))
    residual = corners / 64
    residual[1] = torch.nan
    rows = SignOutcomes(
        journey=torch.tensor([0, 1, 1]),
        row=torch.tensor([4, 0, 9]),
        frame=torch.tensor([70, 71, 71]),
        shape=shape,
        fate=torch.tensor([0, 1, 0]),
        sign=torch.tensor([1, -1, 0]),
        near_sign=torch.tensor([-1, 0, -1]),
        given_up=torch.tensor([False, False, True]),
        corners_px=corners,
        residual_px=residual,
    )
    return NamedOutcomes(rows, ("a", "b"), ("in the map", "in no track"), ("s0", "s1"))


def test_what_is_written_is_read(outcomes: NamedOutcomes, tmp_path: Path) -> None:
    path = tmp_path / "sign_detections.parquet"
    write_sign_outcomes(path, outcomes)
    found = read_sign_outcomes(path, outcomes.sign_id)
    assert found.journey_id == outcomes.journey_id and found.fate == outcomes.fate
    for name, values in vars(outcomes.rows).items():
        assert torch.equal(getattr(found.rows, name).nan_to_num(-9), values.nan_to_num(-9)), name


def test_signs_that_are_not_asked_for_are_none(outcomes: NamedOutcomes, tmp_path: Path) -> None:
    path = tmp_path / "sign_detections.parquet"
    write_sign_outcomes(path, outcomes)
    assert read_sign_outcomes(path, ("s1",)).rows.sign.tolist() == [0, -1, -1]


def test_a_corner_that_is_missing_is_told(outcomes: NamedOutcomes, tmp_path: Path) -> None:
    path = tmp_path / "sign_detections.parquet"
    write_sign_outcomes(path, outcomes)
    table = pq.read_table(path)
    short = pa.array([[1.0, 2.0], *table["u"].to_pylist()[1:]], pa.list_(pa.float32()))
    pq.write_table(table.set_column(table.column_names.index("u"), "u", short), path)
    with pytest.raises(ValueError, match=r"row 0.*'u': 2 numbers; expected 3, one a corner"):
        read_sign_outcomes(path, ("s0",))
