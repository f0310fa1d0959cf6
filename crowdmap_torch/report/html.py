"""report.html: one file that opens without a network and tells a person what a run has made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.report import plots
from crowdmap_torch.report.assets import SCRIPT, STYLE
from crowdmap_torch.report.calibration import calibration_table, plot_calibration
from crowdmap_torch.report.map_section import map_section
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.report.tables_html import (
    bias_table,
    error_table,
    headline_cards,
    reasons_table,
    sign_table,
    simple_table,
    timing_table,
)


def write_report(path: Path, record: RunRecord) -> None:
    """Write `record` as one self-contained HTML file, complete or not at all."""
    with atomic_file(path) as beside:
        beside.write_text(report_html(record), encoding="utf-8")


def report_html(record: RunRecord) -> str:
    """The report as text."""
    return page_html(record.title, record.subtitle, [s for s in _sections(record) if s[2]])


def page_html(title: str, subtitle: str, sections: Sequence[tuple[str, str, str]]) -> str:
    """A page of sections (anchor, title and content), complete in itself."""
    links = "".join(f'<a href="#{name}">{escape(heading)}</a>' for name, heading, _ in sections)
    body = "".join(
        f'<section id="{name}"><h2>{escape(heading)}</h2>{content}</section>'
        for name, heading, content in sections
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>"
        f'<header><div class="wrap"><h1>{escape(title)}</h1>'
        f"<p>{escape(subtitle)}</p></div></header>"
        f'<nav><div class="wrap">{links}</div></nav><main class="wrap">{body}</main>'
        '<footer class="wrap">All lengths in metres, east north up from the map\'s origin. '
        f"</footer><script>{SCRIPT}</script></body></html>\n"
    )


def _sections(record: RunRecord) -> Iterator[tuple[str, str, str]]:
    """Anchor, title and content of each section; those without content are left out."""
    yield "warnings", "Looks wrong", _warnings(record)
    yield "headline", "At a glance", headline_cards(record)
    told = note(
        "A click shows what is known of a sign. A row of the table of signs leads here too."
    )
    yield "map", "Map", told + map_section(record)
    yield "errors", "Errors", _errors(record)
    yield "journeys", "Journeys", _journeys(record)
    yield "calibration", "Calibration", _calibration(record)
    yield "clusters", "Clusters", _clusters(record)
    yield "residuals", "Residuals", _residuals(record)
    yield "adjustment", "Bundle adjustment", _adjustment(record)
    yield "signs", "Signs", sign_table(record)
    yield "pruned", "Left out", _pruned(record)
    yield "timings", "Timings", timing_table(record.timings_s)
    yield "config", "Configuration", _config(record)


def _warnings(record: RunRecord) -> str:
    if not record.warnings:
        return ""
    rows = [(w.seen(len(record.journeys)), w.cause, w.cure) for w in record.warnings]
    head = ("what was seen", "likely cause", "cure")
    return '<div class="box warn">' + simple_table(head, rows) + "</div>"


def _errors(record: RunRecord) -> str:
    if record.figures is None:
        return ""
    drawn = ""
    if record.comparison is not None and bool(record.comparison.counted.any()):
        oracle = record.figures.oracle
        drawn = drawing(
            plots.plot_sign_errors(
                record.comparison,
                record.comparison_before,
                oracle_m=oracle.total.mean if oracle is not None else float("nan"),
            )
        )
    return drawn + error_table(record.figures, record.figures_before)


def _journeys(record: RunRecord) -> str:
    named = [
        *(("set aside", r) for r in record.rejected),
        *(("outlier", r) for r in record.outlier_journeys),
        *(("outage", r) for r in record.outages),
    ]
    warning = ""
    if named:
        rows = [(kind, r.journey_id, r.reason) for kind, r in named]
        warning = (
            '<div class="box warn">' + simple_table(("", "journey", "reason"), rows) + "</div>"
        )
        warning = (
            "<h3>Journeys set aside, or without weight on all or some of their way</h3>" + warning
        )
    if not record.journeys:
        return warning
    return (
        note(
            "Bias: what is to be added to the positions as given, in the mean over the journey. What all journeys have "
            "wrong alike is in none of them."
        )
        + drawing(plots.plot_bias(record.journeys))
        + bias_table(record.journeys)
        + warning
    )


def _calibration(record: RunRecord) -> str:
    if not record.calibration:
        return ""
    told = note(
        "What every car has wrong against its rig.yaml, found with the map. Near 0 the sigma over that of the prior says "
        "that it was seen, near 1 that it is held where it was stated. calibration.json has all numbers, rigs/ has rig.yaml "
        "files with what was found put right."
    )
    return (
        told + drawing(plot_calibration(record.calibration)) + calibration_table(record.calibration)
    )


def _clusters(record: RunRecord) -> str:
    if not record.spectra:
        return ""
    return note(
        "Eigenvalues of the graph Laplacian: as many are small as there are landmarks; "
        "the gap after them is where the number was read off."
    ) + drawing(plots.plot_eigengaps(record.spectra))


def _residuals(record: RunRecord) -> str:
    if not any(len(r) for r in record.residual_px.values()):
        return ""
    return note("Share of the reprojection residuals below each size, stage by stage.") + drawing(
        plots.plot_residuals(record.residual_px)
    )


def _adjustment(record: RunRecord) -> str:
    if not record.iterations:
        return ""
    steps = len(record.iterations)
    first, last = record.iterations[0].total, record.iterations[-1].total
    outcome = record.outcome[:1].upper() + record.outcome[1:]
    told = f"{steps} iterations, cost {first:.4g} to {last:.4g}. {outcome}".strip()
    return note(told) + drawing(plots.plot_convergence(record.iterations))


def _pruned(record: RunRecord) -> str:
    parts = []
    if record.pruned:
        parts.append(
            "<div><h3>What was left out, and why</h3>" + reasons_table(record.pruned) + "</div>"
        )
    if record.counts:
        rows = [(name, _count(value)) for name, value in record.counts.items()]
        parts.append("<div><h3>Counts</h3>" + simple_table(("", "count"), rows) + "</div>")
    return f'<div class="two">{"".join(parts)}</div>' if parts else ""


def _config(record: RunRecord) -> str:
    if not record.config_yaml:
        return ""
    return f'<div class="box"><pre>{escape(record.config_yaml)}</pre></div>'


def _count(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.3f}"


def drawing(figure: Figure) -> str:
    """A figure, as an element of a page."""
    return f'<div class="box">{plots.svg(figure)}</div>'


def note(text: str) -> str:
    """A paragraph beside a figure or table."""
    return f'<p class="note">{escape(text)}</p>'
