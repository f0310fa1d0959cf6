"""The paper's first figure: errors of sign corners over the number of journeys; and the same for lanes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import astuple

from crowdmap_torch.simulate.positioning import PositioningConfig
from crowdmap_torch.studies import paper
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import Line, Panel, Point, plot_lines
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import curve, in_turns, our_maps, paper_heads
from crowdmap_torch.studies.numbers import (
    Result,
    numbers,
    pooled_std,
    results,
    seconds,
    spread,
    spread_of,
)
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import Task

ERRORS = {
    "absolute": "absolute.total",
    "relative": "relative.total",
    "horizontal": "absolute.horizontal",
    "vertical": "absolute.vertical",
}
"""Panels of the first figure, and where their numbers are among the figures of signs."""
LANES = {
    "lateral": "lateral",
    "vertical": "vertical",
    "lateral, the signs' shift taken off": "lateral_without_shift",
    "lane width": "width",
}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """Ours and the paper's cluster heads for every number of journeys."""
    scale = settings.scale
    for count in scale.counts:
        yield from in_turns(scale, our_maps(scale, count))
        if 1 < count <= scale.journeys:
            yield from in_turns(scale, paper_heads(scale, count, seeds=scale.curve_seeds))


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """The curves, and the figures at the paper's number of journeys."""
    scale = settings.scale
    ours = curve(scale, {count: our_maps(scale, count) for count in scale.counts}, folder)
    heads = {
        count: paper_heads(scale, count, seeds=scale.curve_seeds)
        for count in scale.counts
        if 1 < count <= scale.journeys
    }
    theirs = curve(scale, heads, folder)
    alone = results(_single_journeys(scale), folder)
    return Chapter(
        text=(
            "Mean errors against the exact survey. Bars: 1-sigma over the signs of all seeds, as in the paper. The "
            "statistical bound is the mean error of one journey's own signs divided by the root of the number of "
            "journeys, the bias that all journeys share added in squares (zero in this preset). The average is that "
            "of the journeys' own signs, had somebody told which sign each of them is. The oracle knows the signs "
            "and errs by the mean true pose error.",
            "paper2017: the cluster heads of the paper's method on the same drives. Stars: what the paper says of its "
            "own drives. Of one and two journeys, signs count that all of them saw.",
            "Lanes are looked for within 0.5 m to the side: the error of one journey is cut off there.",
        ),
        tables=(
            _target_table(scale, folder),
            _curve_table(ours, theirs, alone, scale),
            _lane_table(ours),
        ),
        plots={
            "journeys": plot_lines(
                [
                    _sign_panel(name, path, ours, theirs, alone, scale)
                    for name, path in ERRORS.items()
                ],
                x="journeys",
                y="error [m]",
                rows=2,
            ),
            "journeys-lanes": plot_lines(
                [_lane_panel(name, part, ours) for name, part in LANES.items()],
                x="journeys",
                y="error [m]",
                rows=2,
            ),
        },
    )


def shared_bias_m(positioning: PositioningConfig) -> float:
    """Length of the bias that all journeys share."""
    parts = ("shared_bias_e_m", "shared_bias_n_m", "shared_bias_u_m")
    return math.hypot(*(getattr(positioning, part) for part in parts))


def statistical_bound(alone: Sequence[Result], path: str, count: int, shared_m: float) -> float:
    """What is left of the error of one journey when `count` independent ones are averaged."""
    one = spread_of(alone, f"signs.{path}.mean").mean
    return math.hypot(one / math.sqrt(count), shared_m)


def _single_journeys(scale: Scale) -> list[Task]:
    """The journeys of the datasets that the curves are drawn from."""
    return [journey for task in our_maps(scale, scale.journeys) for journey in task.journeys()]


def _line(label: str, found: dict[int, list[Result]], at: str, style: str = "-") -> Line:
    """Means over the number of journeys; a solid line with its 1-sigma."""
    mean = [spread_of(maps, f"{at}.mean").mean for maps in found.values()]
    sigma = [pooled_std(maps, at) for maps in found.values()] if style == "-" else None
    return Line(label, list(found), mean, sigma, style)


def _sign_panel(
    name: str,
    path: str,
    ours: dict[int, list[Result]],
    theirs: dict[int, list[Result]],
    alone: list[Result],
    scale: Scale,
) -> Panel:
    counts = list(ours)
    shared = shared_bias_m(scale.drives(0).positioning) if name != "relative" else 0.0

    bound = [statistical_bound(alone, path, count, shared) for count in counts]
    lines = [
        _line("ours", ours, f"map.signs.{path}"),
        _line("paper2017, cluster heads", theirs, f"heads.signs.{path}"),
        _line("average of single journeys", ours, f"average.{path}", "--"),
        Line("statistical bound", counts, bound, style=":"),
    ]
    if name != "relative":
        part = path.removeprefix("absolute.")
        lines.append(_line("oracle", ours, f"map.oracle.{part}", "-."))
    said = {"absolute": paper.ABSOLUTE_M, "relative": paper.RELATIVE_M}
    points = [Point("the paper's drives", paper.JOURNEYS, said[name])] if name in said else []
    return Panel(f"{name} error of sign corners", lines, points)


def _lane_panel(name: str, part: str, ours: dict[int, list[Result]]) -> Panel:
    lines = [
        _line("ours", ours, f"map.lanes.{part}"),
        _line("ours, before adjustment", ours, f"heads.lanes.{part}", "--"),
    ]
    if counts := list(ours):
        one = lines[0].y[0] * math.sqrt(counts[0])
        ideal = [one / math.sqrt(n) for n in counts]
        lines.append(Line("of one journey / root of n", counts, ideal, style=":"))
    return Panel(name, lines)


def _target_table(scale: Scale, folder: StudyFolder) -> Table:
    """What issue and paper ask for, and what was measured, over all seeds at the number that counts."""
    ours = results(our_maps(scale, scale.journeys), folder)
    heads = results(paper_heads(scale, scale.journeys, seeds=scale.seeds), folder)
    absolute, relative, oracle = (
        numbers(ours, f"map.{of}.total.mean")
        for of in ("signs.absolute", "signs.relative", "oracle")
    )
    relative_heads = numbers(heads, "heads.signs.relative.total.mean")
    taken_off = [1 - r / spread(relative_heads).mean for r in relative]
    gain = "{} to {}".format(*paper.BUNDLE_GAIN)
    rows = (
        ("absolute error [m]", f"{paper.ABSOLUTE_M}", absolute),
        ("oracle [m]", "", oracle),
        ("absolute / oracle", "", numbers(ours, "map.absolute_over_oracle")),
        ("relative error [m]", f"{paper.RELATIVE_M}", relative),
        ("cluster heads of paper2017, relative [m]", f"{paper.RELATIVE_M}", relative_heads),
        ("share taken off them", gain, taken_off),
        ("data loss", f"{paper.DATA_LOSS}", numbers(ours, "map.association.data_loss")),
        ("sign recall", "", numbers(ours, "map.signs.recall")),
        ("sign precision", "", numbers(ours, "map.signs.precision")),
        ("lane recall", "", numbers(ours, "map.lanes.recall")),
        ("lane precision", "", numbers(ours, "map.lanes.precision")),
        ("lane width error [m]", "", numbers(ours, "map.lanes.width.mean")),
        ("seconds of a core for the map, single journeys apart", "", [seconds([r]) for r in ours]),
    )
    return Table(
        "journeys-targets",
        ("", "the paper", "mean", "1-sigma over seeds", "least", "most", "seeds"),
        tuple((name, said, *astuple(spread(values))) for name, said, values in rows),
        f"{scale.journeys} journeys",
    )


def _curve_table(
    ours: dict[int, list[Result]],
    theirs: dict[int, list[Result]],
    alone: list[Result],
    scale: Scale,
) -> Table:
    shared = shared_bias_m(scale.drives(0).positioning)
    rows = []
    for count, maps in ours.items():
        for name, path in ERRORS.items():
            row = spread_of(maps, f"map.signs.{path}.mean")
            sigma = pooled_std(maps, f"map.signs.{path}")
            heads = (
                spread_of(found, f"heads.signs.{path}.mean").mean
                for found in (maps, theirs.get(count, []))
            )
            average = spread_of(maps, f"average.{path}.mean").mean
            bound = statistical_bound(alone, path, count, shared if name != "relative" else 0.0)
            oracle = spread_of(maps, f"map.oracle.{path.removeprefix('absolute.')}.mean").mean
            known = (row.mean, sigma, row.std, *heads, average, bound, oracle, row.count)
            rows.append((count, name, *known))
    columns = (
        "journeys",
        "error",
        "ours [m]",
        "1-sigma over signs",
        "over maps",
        "ours, cluster heads",
        "paper2017, cluster heads",
        "average",
        "bound",
        "oracle",
        "maps",
    )
    return Table("journeys", columns, tuple(rows), "Sign corners, mean error [m]")


def _lane_table(ours: dict[int, list[Result]]) -> Table:
    rows = []
    for count, maps in ours.items():
        for name, part in LANES.items():
            row = spread_of(maps, f"map.lanes.{part}.mean")
            before = spread_of(maps, f"heads.lanes.{part}.mean").mean
            sigma = pooled_std(maps, f"map.lanes.{part}")
            rows.append((count, name, row.mean, sigma, row.std, before, row.count))
    columns = (
        "journeys",
        "error",
        "ours [m]",
        "1-sigma over points",
        "over maps",
        "before adjustment",
        "maps",
    )
    return Table("journeys-lanes", columns, tuple(rows), "Lanes, mean error [m]")


STUDY = Study("journeys", "Errors over the number of journeys", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
