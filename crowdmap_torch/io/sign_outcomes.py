"""RUN/sign_detections.parquet: what became of every sign detection of a run, and what is left of it in the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.columns import Lists, Sheet
from crowdmap_torch.io.truth import index_in
from crowdmap_torch.io.writing import list_column, name_column, write_parquet
from crowdmap_torch.tables import Rows

_COLUMNS = ("journey_id", "row", "frame", "shape", "fate", "sign_id", "near_sign_id", "given_up")


@dataclass(frozen=True)
class SignOutcomes(Rows):
    """Sign detections of all journeys, those dropped at the door left out."""

    journey: Int[Tensor, " d"]
    row: Int[Tensor, " d"]
    """Of the journey's signs.parquet."""
    frame: Int[Tensor, " d"]
    """Frame number."""
    shape: Int[Tensor, " d"]
    """Index into `polygon.SHAPES`."""
    fate: Int[Tensor, " d"]
    """Index into the names of the fates: the map, or what it failed at."""
    sign: Int[Tensor, " d"]
    """Index into the map's signs; -1 for none."""
    near_sign: Int[Tensor, " d"]
    """Of a detection in no sign, the sign whose projection it lies on; -1 for none."""
    given_up: Bool[Tensor, " d"]
    """True where the adjustment took it for an outlier."""
    corners_px: Float[Tensor, "d 8 2"]
    """As detected; in the order of the sign's corners where there is a residual."""
    residual_px: Float[Tensor, "d 8 2"]
    """Projected minus detected corner, of the adjusted map by the true camera; NaN where it had no say."""


@dataclass(frozen=True)
class NamedOutcomes:
    """A table of outcomes, and what its indices stand for."""

    rows: SignOutcomes
    journey_id: tuple[str, ...]
    fate: tuple[str, ...]
    sign_id: tuple[str, ...]


def write_sign_outcomes(path: Path, found: NamedOutcomes) -> None:
    """Writes sign_detections.parquet, pixels as float32."""
    rows = found.rows
    mask = polygon.corner_mask(rows.shape)
    has_residual = rows.residual_px.isfinite().all(-1).all(-1)
    count = mask.sum(1)
    pixels = {
        name: (values[mask][:, k].numpy(), count.numpy())
        for name, values, k in (("u", rows.corners_px, 0), ("v", rows.corners_px, 1))
    }
    seen = mask & has_residual[:, None]
    pixels |= {
        name: (rows.residual_px[seen][:, k].numpy(), seen.sum(1).numpy())
        for k, name in enumerate(("du", "dv"))
    }
    write_parquet(
        path,
        {
            "journey_id": name_column(rows.journey.numpy(), found.journey_id),
            "row": rows.row.numpy(),
            "frame": rows.frame.numpy(),
            "shape": name_column(rows.shape.numpy(), polygon.SHAPES),
            "fate": name_column(rows.fate.numpy(), found.fate),
            "sign_id": name_column(rows.sign.numpy(), found.sign_id),
            "near_sign_id": name_column(rows.near_sign.numpy(), found.sign_id),
            "given_up": pa.array(rows.given_up.numpy()),
            **{
                n: list_column(v.astype(np.float32), c, pa.float32())
                for n, (v, c) in pixels.items()
            },
        },
    )


def read_sign_outcomes(path: Path, sign_id: Sequence[str]) -> NamedOutcomes:
    """The outcomes of a run whose map has the signs named; other ids (tentative ones) count as none.

    InputError for a file that no run wrote.
    """
    with reading(inside=path.parent):
        return _read(path, sign_id)


def _read(path: Path, sign_id: Sequence[str]) -> NamedOutcomes:
    sheet = Sheet(path, (*_COLUMNS, "u", "v", "du", "dv"))
    journeys, fates = (sheet.strings(name) for name in ("journey_id", "fate"))
    journey_id, fate = (tuple(dict.fromkeys(c.to_pylist())) for c in (journeys, fates))
    shape = torch.from_numpy(sheet.codes("shape", polygon.SHAPES))
    count = polygon.corner_count(shape).numpy()
    lists = {name: sheet.number_lists(name) for name in ("u", "v", "du", "dv")}
    for name, one in lists.items():
        least = 0 if name in ("du", "dv") else 1
        sheet.refuse(
            (one.count != count) & ((one.count > 0) | (least > 0)),
            lambda row, name=name, one=one: (
                f"column {name!r}: {one.count[row]} numbers; expected {count[row]}, one a corner"
            ),
        )
    corners, residual = (
        torch.stack([_padded(lists[u], count), _padded(lists[v], count)], dim=-1)
        for u, v in (("u", "v"), ("du", "dv"))
    )
    rows = SignOutcomes(
        journey=index_in(journeys, journey_id),
        row=torch.from_numpy(sheet.integers("row")),
        frame=torch.from_numpy(sheet.integers("frame")),
        shape=shape,
        fate=index_in(fates, fate),
        sign=index_in(sheet.strings("sign_id", optional=True), sign_id),
        near_sign=index_in(sheet.strings("near_sign_id", optional=True), sign_id),
        given_up=torch.from_numpy(sheet.flags("given_up")),
        corners_px=corners,
        residual_px=residual,
    )
    return NamedOutcomes(rows, journey_id, fate, tuple(sign_id))


def _padded(lists: Lists, count: Int[np.ndarray, " n"]) -> Float[Tensor, "n 8"]:
    """Lists of as many numbers as corners, the last one repeated; NaN where a list is empty."""
    padded = np.full((len(count), polygon.MAX_CORNERS), np.nan)
    known = lists.count > 0
    slot = np.minimum(np.arange(polygon.MAX_CORNERS), count[:, None] - 1)
    padded[known] = lists.values[(lists.start[:, None] + slot)[known]]
    return torch.from_numpy(padded)
