"""The positioning presets, checked by the paper's own method: its cluster heads must err as the paper's map does."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import astuple, replace

from crowdmap_torch.simulate.positioning import POSITIONING_PRESETS, PositioningConfig
from crowdmap_torch.studies import paper
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import Panel, Point, line_of, plot_lines
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import curve, paper_heads
from crowdmap_torch.studies.numbers import results, spread_of
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task

SHARED_M = 0.1
"""Along each axis, the bias that all journeys share in the third variant [m]."""
POSITIONING: Mapping[str, PositioningConfig] = {
    "paper": POSITIONING_PRESETS["paper"],
    "consumer": POSITIONING_PRESETS["consumer"],
    "paper, a bias shared by all": replace(
        POSITIONING_PRESETS["paper"],
        shared_bias_e_m=SHARED_M,
        shared_bias_n_m=SHARED_M,
        shared_bias_u_m=SHARED_M,
    ),
}
ABSOLUTE_M = (0.15, 0.20)
RELATIVE_M = (0.10, 0.16)
"""Where `paper` is to land at the paper's number of journeys."""
_ERRORS = {"absolute": ABSOLUTE_M, "relative": RELATIVE_M}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """The paper's cluster heads by positioning, number of journeys and seed."""
    scale = settings.scale
    for name in POSITIONING:
        for count in _counts(scale):
            for task in _maps(scale, name, count):
                # What decides comes first.
                is_judged = name == "paper" and count == scale.journeys
                yield task.simulation.seed // 2 if is_judged else 2 * task.simulation.seed + 1, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Errors over the number of journeys, and where the presets land."""
    scale, counts = settings.scale, _counts(settings.scale)
    found = {
        name: curve(scale, {count: _maps(scale, name, count) for count in counts}, folder)
        for name in POSITIONING
    }
    judged = results(_maps(scale, "paper", scale.journeys), folder)
    rows, panels = [], []
    for error, (low, high) in _ERRORS.items():
        path = f"heads.signs.{error}.total.mean"
        all_seeds = astuple(spread_of(judged, path))
        asked = f"{low:.2f} to {high:.2f}"
        rows.append(("paper, all seeds", error, scale.journeys, *all_seeds, asked))
        lines = []
        for name, by_count in found.items():
            means = {count: spread_of(maps, path) for count, maps in by_count.items()}
            lines.append(line_of(name, counts, list(means.values())))
            rows += [(name, error, count, *astuple(row), "") for count, row in means.items()]
        said = paper.ABSOLUTE_M if error == "absolute" else paper.RELATIVE_M
        point = Point("the paper's drives", paper.JOURNEYS, said)
        panels.append(Panel(f"{error} error, cluster heads of paper2017", lines, [point]))
    columns = (
        "positioning",
        "error",
        "journeys",
        "mean [m]",
        "1-sigma over seeds",
        "least",
        "most",
        "seeds",
        "asked",
    )
    p = POSITIONING["paper"]
    return Chapter(
        text=(
            f"`paper` is set so that the paper's own method, an average of {paper.JOURNEYS} journeys, has the paper's "
            f"errors: each journey has a constant bias of {p.bias_e_m:.2f}, {p.bias_n_m:.2f} and {p.bias_u_m:.2f} m "
            f"(1-sigma east, north, up), a drift of {p.drift_m:.2f} m that forgets itself over {p.drift_length_m:.0f} m, "
            f"and {p.drift_rot_deg:.2f} degrees of it in rotation; signs are last seen from 12 m. Our method had no part "
            "in it. `consumer` has the larger biases of a plain receiver. Signs alone, no lanes.",
            "Independent biases go on falling with the root of the number of journeys; the paper's curve does not. A bias "
            f"that all journeys share, here {SHARED_M:.2f} m along each axis, makes such a floor: no number of journeys "
            "averages it away, and the relative error does not see it. Bars: 1-sigma over seeds.",
        ),
        tables=(Table("preset", columns, tuple(rows)),),
        plots={"preset": plot_lines(panels, x="journeys", y="mean corner error [m]")},
    )


def _counts(scale: Scale) -> list[int]:
    return [count for count in scale.counts if 1 < count <= scale.journeys]


def _maps(scale: Scale, name: str, count: int) -> list[MeasureMap]:
    if name == "paper":
        return paper_heads(scale, count)
    heads = paper_heads(scale, count, seeds=scale.other_preset_seeds)
    return [
        replace(task, simulation=replace(task.simulation, positioning=POSITIONING[name]))
        for task in heads
    ]


STUDY = Study("preset", "The positioning presets", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
