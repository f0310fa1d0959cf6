"""Detections of the same sign in the same landmark (METRICS.md, Association)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from crowdmap_torch.evaluation.statistics import share
from crowdmap_torch.io.truth import SignAssociations, Truth


@dataclass(frozen=True)
class AssociationFigures:
    """How well detections were told apart."""

    detections: int
    """Of true signs, in the journeys in use."""
    pair_precision: float
    """Of all pairs of detections in one landmark, the share that shows one true sign."""
    pair_recall: float
    """Of all pairs of detections of one true sign, the share that is in one landmark."""
    data_loss: float
    """Share of the detections of observable true signs that are in no landmark of the map."""
    data_loss_without_outliers: float
    """The same over detections whose geometry is not grossly wrong."""


def evaluate_association(
    associations: SignAssociations, truth: Truth, observable: Bool[Tensor, " n"]
) -> AssociationFigures:
    """Figures of which detections went into which landmark, over all journeys.

    `associations.journey` indexes `truth.journeys`; `observable` speaks of the survey's signs.
    """
    sign = torch.cat([t.sign for t in truth.journeys] or [associations.row[:0]])
    outlier = torch.cat([t.sign_outlier for t in truth.journeys] or [observable[:0]])
    rows = torch.tensor([len(t.sign) for t in truth.journeys], device=sign.device)
    start = rows.cumsum(0) - rows
    if bool((associations.row >= rows[associations.journey]).any()):
        raise ValueError(
            "associations.parquet has rows that the journeys' signs.parquet have not: "
            "is it the run of another dataset?"
        )
    landmark = torch.full_like(sign, -1)
    landmark[start[associations.journey] + associations.row] = associations.landmark
    true = sign >= 0
    together = _pairs(_cells(sign, landmark)[true & (landmark >= 0)])
    lost = (landmark < 0) & true
    # One more for what is no sign: of none that are surveyed there is no first one.
    counted = true & torch.cat((observable, observable.new_zeros(1)))[sign]
    clean = counted & ~outlier
    return AssociationFigures(
        detections=int(true.sum()),
        pair_precision=share(together, _pairs(landmark[landmark >= 0])),
        pair_recall=share(together, _pairs(sign[true])),
        data_loss=share(int((lost & counted).sum()), int(counted.sum())),
        data_loss_without_outliers=share(int((lost & clean).sum()), int(clean.sum())),
    )


def _cells(sign: Int[Tensor, " d"], landmark: Int[Tensor, " d"]) -> Int[Tensor, " d"]:
    """One number for each combination of a true sign and a landmark."""
    width = int(landmark.max()) + 2 if len(landmark) else 1
    return sign * width + landmark


def _pairs(group: Int[Tensor, " d"]) -> int:
    """How many pairs of rows are in the same group."""
    _, count = group.unique(return_counts=True)
    return int((count * (count - 1)).sum()) // 2
