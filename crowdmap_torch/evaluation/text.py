"""The figures as a table for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator

from crowdmap_torch.evaluation.lanes import LaneFigures
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.evaluation.single_journey import SingleJourneyFigures
from crowdmap_torch.evaluation.statistics import ErrorFigures, PositionFigures

_WIDTH = 34
_COLUMNS = "      mean    median       p95     count"


def format_figures(figures: MapFigures) -> str:
    """One line for each figure, grouped as METRICS.md groups them; '-' for what is unknown."""
    return "\n".join(_lines(figures))


def _lines(figures: MapFigures) -> Iterator[str]:
    yield from _sign_lines(figures)
    if figures.lanes is not None:
        yield from _lane_lines(figures.lanes)
    if figures.single_journey is not None:
        yield from _journey_lines(figures.single_journey)
    if figures.association is not None:
        a = figures.association
        yield _heading("Association", "")
        yield _row("pair precision", percent_text(a.pair_precision))
        yield _row("pair recall", percent_text(a.pair_recall))
        yield _row("data loss", percent_text(a.data_loss))
        yield _row("data loss without outliers", percent_text(a.data_loss_without_outliers))
    if figures.uncertainty is not None and figures.uncertainty.signs:
        u = figures.uncertainty
        yield _heading("Uncertainty", "")
        yield _row("centres in 95 % ellipsoid", f"{percent_text(u.coverage)} of {u.signs}")
        yield _row("mean NEES (3 is right)", number_text(u.mean_nees))
        yield _row("NEES of shift (0.22 to 9.35)", number_text(u.shared_nees))
    yield from (f"note: {note}" for note in figures.notes)


def _sign_lines(figures: MapFigures) -> Iterator[str]:
    s = figures.signs
    yield _heading("Signs", "")
    yield _row("map signs", f"{s.map_signs}")
    yield _row("true / observable", f"{s.true_signs} / {s.observable}")
    yield _row("matched / observable ones", f"{s.matched} / {s.matched_observable}")
    yield _row("recall", percent_text(s.recall))
    yield _row("precision", percent_text(s.precision))
    yield _row("duplicates / false", f"{s.duplicates} / {s.false}")
    yield _row("shape accuracy", percent_text(s.shape_accuracy))
    if s.close_pairs:
        told_apart = f"{percent_text(s.close_pairs_told_apart)} of {s.close_pairs}"
        yield _row("close pairs told apart", told_apart)
    yield _row("median shift e n u [m]", " ".join(f"{v:+.3f}" for v in s.median_shift))
    if figures.control_signs:
        yield _row("control signs left out", f"{figures.control_signs}")
    yield _heading("Sign errors [m]", _COLUMNS)
    yield from _positions("absolute corner", s.absolute)
    if figures.oracle is not None:
        yield from _positions("oracle corner", figures.oracle)
        yield _row("absolute / oracle", number_text(figures.absolute_over_oracle))
    yield from _positions("relative corner", s.relative)
    yield from _positions("absolute centre", s.absolute_center)
    yield from _positions("relative centre", s.relative_center)
    yield _errors("width", s.width)
    yield _errors("height", s.height)
    yield _errors("normal [deg]", s.normal_deg)


def _lane_lines(lane: LaneFigures) -> Iterator[str]:
    yield _heading("Lanes [m]", _COLUMNS)
    yield _errors("lateral", lane.lateral)
    yield _errors("vertical", lane.vertical)
    yield _errors("lateral without shift", lane.lateral_without_shift)
    yield _errors("vertical without shift", lane.vertical_without_shift)
    yield _errors("lane width", lane.width)
    yield _row("recall", f"{percent_text(lane.recall)} of {lane.seen_length_m:.0f} m seen")
    yield _row("precision", f"{percent_text(lane.precision)} of {lane.map_length_m:.0f} m mapped")
    yield _row("duplicates", percent_text(lane.duplicates))
    yield _row("inside own 95 % interval", percent_text(lane.sigma_coverage))


def _journey_lines(one: SingleJourneyFigures) -> Iterator[str]:
    yield _heading("One journey [m]", _COLUMNS)
    yield from _positions("corner", one.corner)
    yield _errors("centre", one.center.total)
    yield _errors("normal [deg]", one.normal_deg)
    yield _errors("lane lateral", one.lane_lateral)
    yield _errors("lane vertical", one.lane_vertical)
    yield _errors("lane width", one.lane_width)
    yield _row("sign recall", percent_text(one.recall))
    yield _row(
        "ghosts / duplicates", f"{percent_text(one.ghosts)} / {percent_text(one.duplicates)}"
    )
    yield _row("lane precision", percent_text(one.lane_precision))


def _heading(title: str, columns: str) -> str:
    return f"{title:<{_WIDTH}}{columns}".rstrip()


def _row(name: str, value: str) -> str:
    return f"  {name:<{_WIDTH - 2}}{value}"


def _positions(name: str, figures: PositionFigures) -> Iterator[str]:
    yield _errors(name, figures.total)
    yield _errors(f"{name}, horizontal", figures.horizontal)
    yield _errors(f"{name}, vertical", figures.vertical)


def _errors(name: str, errors: ErrorFigures) -> str:
    numbers = "".join(f"{number_text(v):>10}" for v in (errors.mean, errors.median, errors.p95))
    return f"  {name:<{_WIDTH - 2}}{numbers}{errors.count:>10}"


def number_text(value: float) -> str:
    """Three digits; '-' for what is unknown."""
    return f"{value:.3f}" if math.isfinite(value) else "-"


def percent_text(value: float) -> str:
    """A share in percent; '-' for what is unknown."""
    return f"{100 * value:.1f} %" if math.isfinite(value) else "-"
