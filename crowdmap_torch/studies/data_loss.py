"""The paper's second figure: what clustering leaves out, over the number of journeys."""

from __future__ import annotations

from collections.abc import Iterator

from crowdmap_torch.studies import paper
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import Panel, Point, line_of, plot_lines
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import curve, in_turns, our_maps, paper_heads
from crowdmap_torch.studies.numbers import Result, Spread, number, spread, spread_of
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import Task

_LEAST = 2
"""One journey's signs are all singletons."""


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """Ours and the paper's cluster heads for every number of journeys but one."""
    scale = settings.scale
    for count in (n for n in scale.counts if n >= _LEAST):
        yield from in_turns(scale, our_maps(scale, count))
        if count <= scale.journeys:
            yield from in_turns(scale, paper_heads(scale, count, seeds=scale.curve_seeds))


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """The paper's measure and METRICS.md's, for both methods."""
    scale = settings.scale
    counts = [n for n in scale.counts if n >= _LEAST]
    within = [n for n in counts if n <= scale.journeys]
    ours = curve(scale, {n: our_maps(scale, n) for n in counts}, folder).values()
    heads = {n: paper_heads(scale, n, seeds=scale.curve_seeds) for n in within}
    theirs = curve(scale, heads, folder).values()
    left_out = {
        "ours": (counts, [_left_out(maps) for maps in ours]),
        "paper2017": (within, [_left_out(maps) for maps in theirs]),
    }
    lost = {
        "ours": (counts, [spread_of(maps, "map.association.data_loss") for maps in ours]),
        "ours, before adjustment": (
            counts,
            [spread_of(maps, "heads.association.data_loss") for maps in ours],
        ),
        "paper2017": (within, [spread_of(maps, "heads.association.data_loss") for maps in theirs]),
    }
    panels = [
        Panel(
            "signs of single journeys left out by clustering",
            [line_of(name, *found) for name, found in left_out.items()],
            [Point("the paper's drives", paper.LOSS_FROM_JOURNEYS, paper.DATA_LOSS)],
        ),
        Panel(
            "detections of observable signs in no landmark",
            [line_of(name, *found) for name, found in lost.items()],
        ),
    ]
    columns = ("journeys", "method", "measure", "share", "1-sigma over maps", "most", "maps")
    rows = tuple(
        (count, method, measure, row.mean, row.std, row.high, row.count)
        for measure, found in (("left out", left_out), ("lost", lost))
        for method, (at, values) in found.items()
        for count, row in zip(at, values, strict=True)
    )
    return Chapter(
        text=(
            "Left: the share of the single journeys' signs that end as singletons, the paper's measure; false signs, "
            "which belong there, are among them. Right: the share of the detections of observable true signs that are "
            "in no landmark, whatever stage lost them (METRICS.md). Ours brings back what clustering left out.",
        ),
        tables=(Table("data-loss", columns, rows),),
        plots={"data-loss": plot_lines(panels, x="journeys", y="share")},
    )


def _left_out(found: list[Result]) -> Spread:
    shares = [
        number(result, "clusters.left_out") / max(number(result, "clusters.signs"), 1.0)
        for result in found
    ]
    return spread(shares)


STUDY = Study("data-loss", "Data loss", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
