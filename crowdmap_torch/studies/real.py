"""Real drives: KITTI's with the traffic signs of Chawla et al. (IROS 2020), one journey each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import OURS, PAPER
from crowdmap_torch.studies.numbers import number
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureReal, Task

GATE_M = 2.0
"""A mapped sign further from the surveyed place is not that sign."""
_METHODS = {"ours": OURS, "paper2017": PAPER}
_NUMBERS = {
    "median [m]": "absolute_center.total.median",
    "mean [m]": "absolute_center.total.mean",
    "95 % [m]": "absolute_center.total.p95",
    "relative, mean [m]": "relative_center.total.mean",
}
_SIGNS = {"journey": "one journey's signs", "heads": "cluster heads", "map": "adjusted"}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """Each sequence by each method."""
    for config in _METHODS.values():
        for task in _drives(settings, config):
            yield 0, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """The signs of each sequence; InputError if the folder that was given has none."""
    if settings.real is None:
        return Chapter(text=("Left out: `--real DIR` names the folder of kitti-signs.",))
    rows = []
    for method, config in _METHODS.items():
        for task in _drives(settings, config):
            if not folder.has_result(task.key):
                continue
            result = folder.read_result(task.key)
            for name, signs in _SIGNS.items():
                if name != "journey" and method == "paper2017":
                    # To the paper's clustering the signs of one journey are singletons.
                    continue
                counts = (
                    round(number(result, path))
                    for path in (
                        "frames",
                        f"{name}.signs.observable",
                        f"{name}.signs.matched_observable",
                    )
                )
                errors = (number(result, f"{name}.signs.{path}") for path in _NUMBERS.values())
                spent = number(result, "seconds")
                rows.append((method, task.dataset.name, signs, *counts, *errors, spent))
    counted = ("frames", "eligible", "mapped")
    columns = ("method", "sequence", "signs", *counted, *_NUMBERS, "seconds of a core")
    return Chapter(
        text=(
            "kitti-signs: reference poses, boxes marked in the images, signs measured with LiDAR to about 6 cm; errors of "
            f"sign centres within {GATE_M:g} m. A sign that was passed twice counts by its better pass among one journey's "
            "signs, by both passes together in the heads and after adjustment. Boxes are not exact corners, and there is "
            "one journey in each sequence. Chawla et al. give 0.26 and 0.39 m of mean relative error, with poses "
            "estimated from the video.",
        ),
        tables=(Table("real", columns, tuple(rows)),),
    )


def _drives(settings: Settings, config: MapperConfig) -> list[MeasureReal]:
    if settings.real is None:
        return []
    folders = sorted(path.parent for path in settings.real.glob("*/dataset.json"))
    if not folders:
        raise InputError(f"{settings.real}: no dataset in it; expected folders with dataset.json")
    # There is one journey in each: what it saw alone is the map.
    alone = replace(config, crowd=replace(config.crowd, min_journeys=1))
    return [MeasureReal(path, settings.real / "eligible.json", GATE_M, alone) for path in folders]


STUDY = Study("real", "Real drives", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
