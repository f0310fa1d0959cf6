"""Whether a map is good, in a sentence: what stands at the top of report.html."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from crowdmap_torch.evaluation.text import percent_text
from crowdmap_torch.report.fates import reason_of
from crowdmap_torch.report.record import RunRecord

GOOD, FAIR, POOR = "good", "fair", "poor"
_LEAST_RECALL = (0.95, 0.8)
_LEAST_PRECISION = (0.97, 0.9)
_MOST_RELATIVE_M = (0.15, 0.4)
_MOST_OVER_ORACLE = (1.5, 2.5)
_LEAST_USED = (0.75, 0.5)
"""Shares of detections."""
_MOST_LEFT_OUT = (0.1, 0.3)
"""Share of journeys."""
_MOST_PX = (1.5, 4.0)
"""Median residual of the adjusted map."""
_MOST_SIGMA_M = (0.25, 0.75)
"""Median of how sure signs are of one another, per axis."""


@dataclass(frozen=True)
class Judgement:
    """One thing that speaks for or against a map: fair where it is outside the first limit, poor outside the second."""

    grade: str
    text: str
    reason: str = ""
    """The dominant one."""


def judgements(record: RunRecord) -> tuple[Judgement, ...]:
    """All that can be judged, the worst first, else in the order in which people ask."""
    order = (POOR, FAIR, GOOD)
    found, told = [], {""}
    for judgement in sorted(_judged(record), key=lambda j: order.index(j.grade)):
        # What explains two things is said once.
        is_new = judgement.reason not in told
        found.append(judgement if is_new else replace(judgement, reason=""))
        told.add(judgement.reason)
    return tuple(found)


def overall(found: tuple[Judgement, ...]) -> str:
    """The grade of the map: that of the worst."""
    return found[0].grade if found else FAIR


def _judged(record: RunRecord) -> Iterator[Judgement]:
    for warning in record.warnings:
        cause = f"{warning.cause}; {warning.cure}"
        grade = POOR if warning.kind.startswith("no-") else FAIR
        yield Judgement(grade, warning.seen(len(record.journeys)), cause)
    yield from _against_survey(record)
    signs = record.hd_map.signs
    for kind in ("sign", "lane"):
        seen = record.counts.get(f"{kind} detections")
        used = record.counts.get(f"{kind} detections used")
        if not isinstance(seen, int | float) or not isinstance(used, int | float) or not seen:
            continue
        grade = _at_least(used / seen, _LEAST_USED)
        text = f"{percent_text(used / seen)} of the {kind} detections are in the map"
        yield Judgement(grade, text, "" if grade == GOOD else _most_lost(record, kind))
    residual = record.residual_px.get("adjusted map")
    if residual is not None and len(residual):
        median = float(residual.median())
        text = f"corners of signs fit to {median:.2f} px in the median"
        yield Judgement(_at_most(median, _MOST_PX), text)
    if len(signs) and record.figures is None:
        own = signs.covariance - record.hd_map.shared_covariance
        sigma = float(own.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(0).sqrt().median())
        text = (
            f"signs are known to {sigma:.2f} m of one another in the median (1-sigma, as estimated)"
        )
        yield Judgement(_at_most(sigma, _MOST_SIGMA_M), text)
    bad = (*record.rejected, *record.outlier_journeys)
    if record.journeys or bad:
        total = len(record.journeys) + len(record.rejected)
        text = f"{total - len(bad)} of {total} journeys have a say"
        reason = f"{bad[0].journey_id}: {bad[0].reason}" if bad else ""
        yield Judgement(_at_most(len(bad) / total, _MOST_LEFT_OUT), text, reason)
    if record.outcome:
        grade = GOOD if record.outcome.startswith("converged") else FAIR
        yield Judgement(grade, f"the adjustment ended: {record.outcome}")


def _against_survey(record: RunRecord) -> Iterator[Judgement]:
    figures = record.figures
    if figures is None:
        return
    signs = figures.signs
    if math.isfinite(signs.recall):
        grade = _at_least(signs.recall, _LEAST_RECALL)
        text = f"{signs.matched_observable} of {signs.observable} observable signs of the survey are in the map"
        yield Judgement(grade, text, "" if grade == GOOD else _most_lost(record, "sign"))
    if math.isfinite(signs.precision):
        wrong = f"{signs.false} false and {signs.duplicates} duplicate signs of {signs.map_signs}"
        yield Judgement(_at_least(signs.precision, _LEAST_PRECISION), wrong)
    corner = signs.relative if signs.relative.total.count else signs.relative_center
    if corner.total.count:
        text = f"signs are {corner.total.mean:.2f} m off relative to one another"
        yield Judgement(_at_most(corner.total.mean, _MOST_RELATIVE_M), text)
    if math.isfinite(figures.absolute_over_oracle):
        ratio, error = figures.absolute_over_oracle, signs.absolute.total.mean
        text = f"signs are {error:.2f} m off in the world, {ratio:.2f} times what positioning leaves (the oracle)"
        yield Judgement(_at_most(ratio, _MOST_OVER_ORACLE), text)
    if figures.lanes is not None and math.isfinite(figures.lanes.recall):
        text = f"{percent_text(figures.lanes.recall)} of the lane markers that were seen are in the map"
        yield Judgement(_at_least(figures.lanes.recall, _LEAST_RECALL), text)


def _most_lost(record: RunRecord, kind: str) -> str:
    """What became of most detections that are not in the map, with its likely cause and cure."""
    lost = [p for p in record.pruned if p.stage == f"{kind} detections"]
    if not lost:
        return ""
    most = max(lost, key=lambda p: p.count)
    cause, cure = reason_of(most.reason)
    total = sum(p.count for p in lost)
    return f"Of {total:,} {kind} detections that are not, {most.count:,} ended {most.reason!r}: {cause}; {cure}"


def _at_least(value: float, limits: tuple[float, float]) -> str:
    return GOOD if value >= limits[0] else FAIR if value >= limits[1] else POOR


def _at_most(value: float, limits: tuple[float, float]) -> str:
    return GOOD if value <= limits[0] else FAIR if value <= limits[1] else POOR
