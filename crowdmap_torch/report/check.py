"""What was found in a data set beside pictures of its drives: one page that opens without a network."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path

import torch
from matplotlib.figure import Figure

from crowdmap_torch.checking.check import NOTE, Check, Item
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.plausibility.consistency import meeting_of
from crowdmap_torch.plausibility.units import read_raw_poses
from crowdmap_torch.report import check_plots
from crowdmap_torch.report.html import drawing, note, page_html
from crowdmap_torch.tables import Journey
from crowdmap_torch.tracking.signs import associate_signs

MOST_JOURNEYS = 12
"""That are drawn, those with findings first."""
_GRID = (
    "display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,340px),1fr));gap:14px;"
    "align-items:start"
)


def write_check_page(path: Path, folder: Path, check: Check, config: MapperConfig) -> None:
    """Writes the page about the data set in `folder`, complete or not at all."""
    text = check_html(folder, check, config)
    with atomic_file(path) as beside:
        beside.write_text(text, encoding="utf-8")


@torch.no_grad()
def check_html(folder: Path, check: Check, config: MapperConfig) -> str:
    """The page as text."""
    used = check.dataset.journeys if check.dataset is not None else ()
    grave = sum(item.severity != NOTE for item in check.items)
    told = f"{len(used)} journeys can be used, {len(check.unseen)} have files that are refused, "
    told += f"{grave} findings stop or spoil a map" if grave else "nothing stops or spoils a map"
    sections = [("findings", "Findings", _findings(check))]
    names = [journey.journey_id for journey in used]
    found_in = {n for item in check.items if item.severity != NOTE for n in item.journeys}
    # Those with findings first, and then as they come.
    order = sorted([*names, *check.unseen], key=lambda name: name not in found_in)
    by_name = {journey.journey_id: journey for journey in used}
    for number, name in enumerate(order[:MOST_JOURNEYS]):
        if name in by_name:
            drawn = _pictures(by_name[name], config)
        else:
            drawn = _refused(folder / "journeys" / name / "poses.parquet")
        boxes = "".join(drawing(figure) for figure in drawn)
        content = _of_journey(check, name) + f'<div style="{_GRID}">{boxes}</div>'
        sections.append((f"journey-{number}", name, content))
    if len(order) > MOST_JOURNEYS:
        left = f"{len(order) - MOST_JOURNEYS} more journeys are not drawn."
        sections.append(("more", "Others", note(left)))
    return page_html(f"Check of {folder.name}", told, sections)


def _findings(check: Check) -> str:
    if not check.items:
        return note("Nothing was found.")
    return "".join(_block(item) for item in check.items)


def _block(item: Item) -> str:
    """A finding as one can read it on a phone too."""
    cure = item.cure + (" (--fix does it)" if item.repairs else "")
    rows = (("seen", item.evidence), ("likely cause", item.cause), ("cure", cure))
    lines = "".join(f"<div><b>{name}:</b> {escape(text)}</div>" for name, text in rows)
    warn = "" if item.severity == NOTE else " warn"
    tag = f'<span class="tag{" false" * bool(warn)}">{escape(item.severity)}</span>'
    head = f"<div>{tag} <b>{escape(item.place)}</b></div>"
    return f'<div class="box{warn}" style="margin-bottom:10px">{head}{lines}</div>'


def _of_journey(check: Check, name: str) -> str:
    own = [item for item in check.items if name in item.journeys and item.severity != NOTE]
    return "".join(f'<p class="note"><b>{escape(_line(item))}</b></p>' for item in own)


def _line(item: Item) -> str:
    return f"{item.evidence}: {item.cause}"


def _pictures(journey: Journey, config: MapperConfig) -> Iterator[Figure]:
    tracks = associate_signs(journey, config.positioning, config.sign_association)
    meeting = meeting_of(journey, tracks)
    yield check_plots.plot_way(journey, meeting)
    if journey.frame_count > 1:
        yield check_plots.plot_motion(journey)
    yield check_plots.plot_image(journey)
    if meeting is not None and len(meeting.sign):
        yield check_plots.plot_reprojection(journey, meeting)
        yield check_plots.plot_scale(journey, meeting)


def _refused(path: Path) -> Iterator[Figure]:
    raw = read_raw_poses(path)
    if raw is not None:
        yield check_plots.plot_columns(raw)
