"""The figures as a table for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from crowdmap_torch.evaluation.statistics import ErrorFigures, PositionFigures

if TYPE_CHECKING:
    from crowdmap_torch.evaluate import MapFigures

_WIDTH = 34


def format_figures(figures: MapFigures) -> str:
    """One line for each figure, grouped as METRICS.md groups them; '-' for what is unknown."""
    return "\n".join(_lines(figures))


def _lines(figures: MapFigures) -> Iterator[str]:
    s = figures.signs
    yield _heading("Signs", "")
    yield _row("map signs", f"{s.map_signs}")
    yield _row("true / observable", f"{s.true_signs} / {s.observable}")
    yield _row("matched / observable ones", f"{s.matched} / {s.matched_observable}")
    yield _row("recall", _percent(s.recall))
    yield _row("precision", _percent(s.precision))
    yield _row("duplicates / false", f"{s.duplicates} / {s.false}")
    yield _row("shape accuracy", _percent(s.shape_accuracy))
    if s.close_pairs:
        yield _row(
            "close pairs told apart", f"{_percent(s.close_pairs_told_apart)} of {s.close_pairs}"
        )
    yield _row("median shift e n u [m]", " ".join(f"{v:+.3f}" for v in s.median_shift))
    if figures.control_signs:
        yield _row("control signs left out", f"{figures.control_signs}")
    yield _heading("Sign errors [m]", "      mean    median       p95     count")
    yield from _positions("absolute corner", s.absolute)
    if figures.oracle is not None:
        yield from _positions("oracle corner", figures.oracle)
        yield _row("absolute / oracle", _number(figures.absolute_over_oracle))
    yield from _positions("relative corner", s.relative)
    yield from _positions("absolute centre", s.absolute_center)
    yield from _positions("relative centre", s.relative_center)
    yield _errors("width", s.width)
    yield _errors("height", s.height)
    yield _errors("normal [deg]", s.normal_deg)
    if figures.lanes is not None:
        lane = figures.lanes
        yield _heading("Lanes [m]", "      mean    median       p95     count")
        yield _errors("lateral", lane.lateral)
        yield _errors("vertical", lane.vertical)
        yield _errors("lateral without shift", lane.lateral_without_shift)
        yield _errors("vertical without shift", lane.vertical_without_shift)
        yield _errors("lane width", lane.width)
        yield _row("recall", f"{_percent(lane.recall)} of {lane.seen_length_m:.0f} m seen")
        yield _row("precision", f"{_percent(lane.precision)} of {lane.map_length_m:.0f} m mapped")
        yield _row("duplicates", _percent(lane.duplicates))
        yield _row("inside own 95 % interval", _percent(lane.sigma_coverage))
    if figures.single_journey is not None:
        one = figures.single_journey
        yield _heading("One journey [m]", "      mean    median       p95     count")
        yield from _positions("corner", one.corner)
        yield _errors("centre", one.center.total)
        yield _errors("normal [deg]", one.normal_deg)
        yield _errors("lane lateral", one.lane_lateral)
        yield _errors("lane vertical", one.lane_vertical)
        yield _errors("lane width", one.lane_width)
        yield _row("sign recall", _percent(one.recall))
        yield _row("ghosts / duplicates", f"{_percent(one.ghosts)} / {_percent(one.duplicates)}")
        yield _row("lane precision", _percent(one.lane_precision))
    if figures.association is not None:
        a = figures.association
        yield _heading("Association", "")
        yield _row("pair precision", _percent(a.pair_precision))
        yield _row("pair recall", _percent(a.pair_recall))
        yield _row("data loss", _percent(a.data_loss))
        yield _row("data loss without outliers", _percent(a.data_loss_without_outliers))
    if figures.uncertainty is not None and figures.uncertainty.signs:
        u = figures.uncertainty
        yield _heading("Uncertainty", "")
        yield _row("centres in 95 % ellipsoid", f"{_percent(u.coverage)} of {u.signs}")
        yield _row("mean NEES (3 is right)", _number(u.mean_nees))
        yield _row("NEES of shift (0.22 to 9.35)", _number(u.shared_nees))
    yield from (f"note: {note}" for note in figures.notes)


def _heading(title: str, columns: str) -> str:
    return f"{title:<{_WIDTH}}{columns}".rstrip()


def _row(name: str, value: str) -> str:
    return f"  {name:<{_WIDTH - 2}}{value}"


def _positions(name: str, figures: PositionFigures) -> Iterator[str]:
    yield _errors(name, figures.total)
    yield _errors(f"{name}, horizontal", figures.horizontal)
    yield _errors(f"{name}, vertical", figures.vertical)


def _errors(name: str, errors: ErrorFigures) -> str:
    numbers = "".join(f"{_number(v):>10}" for v in (errors.mean, errors.median, errors.p95))
    return f"  {name:<{_WIDTH - 2}}{numbers}{errors.count:>10}"


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %" if math.isfinite(value) else "-"
