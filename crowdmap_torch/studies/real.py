"""Real drives: KITTI's with the traffic signs of Chawla et al. (IROS 2020): as they are, cut into passes, and as crowds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean

from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import OURS, PAPER
from crowdmap_torch.studies.numbers import number
from crowdmap_torch.studies.passes import COPIES, MeasureDrives
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
_KNOWN = replace(OURS, calibration=CalibrationConfig.off())
_SEEN_FROM = {"kitti-00": (-0.060, 0.001, -0.004)}
"""Where KITTI's left colour camera is in the axes of its first camera, by sequence [m]: boxes were drawn in its images."""
_SEEN_FROM_ELSE = (-0.061, 0.001, -0.006)
_KNOWN_TOO = {"as given": (_KNOWN, False), "found, from the boxes' camera": (OURS, True)}
"""What else passes by themselves have known, by what it is called: how, and whether that camera is."""
_CROWDS = {
    "alone": "each pass by itself",
    "passes": "all passes together",
    "copies": f"{COPIES} copies of a pass",
}
_SIGNS = {"journey": "one journey's signs", "heads": "cluster heads", "map": "adjusted"}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """Each sequence by each method, and the passes that it is cut into, alone and as crowds."""
    for config in _METHODS.values():
        for task in _drives(settings, config):
            yield 0, task
    for _, task in _crowds(settings):
        yield 1, task


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
            "estimated from the video. A pass is a piece of a sequence that does not come back to a place. Local errors: "
            "the sign in the adjusted cameras of the frames that it was surveyed from; means over the signs that both have.",
        ),
        tables=(Table("real", columns, tuple(rows)), *_of_crowds(settings, folder)),
    )


def _of_crowds(settings: Settings, folder: StudyFolder) -> Iterator[Table]:
    """The passes' signs in the cameras that they were surveyed from, by themselves and mapped together."""
    rows, every = [], {}
    for calibration, task in _crowds(settings):
        if not folder.has_result(task.key):
            continue
        result = folder.read_result(task.key)
        single, final = result["single"], result["map"]
        both = [(single[name], final[name]) for name in sorted(single.keys() & final.keys())]
        every.setdefault((task.crowd, task.errors, calibration), []).extend(both)
        relative = [_mean([one[name] for one in result["relative"]]) for name in ("single", "map")]
        what = (_CROWDS[task.crowd], task.errors, calibration, task.dataset.name)
        rows.append((*what, result["drives"], *_local(both), *relative, result["seconds"]))
    for (crowd, errors, calibration), both in every.items():
        nothing = (float("nan"),) * 3
        rows.append((_CROWDS[crowd], errors, calibration, "all", "", *_local(both), *nothing))
    if rows:
        columns = (
            *("drives", "pose errors", "calibration", "sequence", "number", "signs"),
            *("single drives, local [m]", "adjusted, local [m]"),
            *("single drives, relative [m]", "adjusted, relative [m]", "seconds of a core"),
        )
        yield Table("passes", columns, tuple(sorted(rows, key=lambda row: row[:4])))


def _mean(errors: list[float | None]) -> float:
    """Of those maps that have a relative error: one of a single sign has none."""
    known = [error for error in errors if error is not None]
    return fmean(known) if known else float("nan")


def _local(both: list[tuple[float, float]]) -> tuple[float, ...]:
    """How many signs, and the means of both errors."""
    if not both:
        return 0, float("nan"), float("nan")
    return len(both), fmean(a for a, _ in both), fmean(b for _, b in both)


def _crowds(settings: Settings) -> Iterator[tuple[str, MeasureDrives]]:
    """The drives that sequences are made into, by what their calibration is."""
    if settings.real is None:
        return
    surveyed_from = settings.real / "surveyed_from.json"
    if not surveyed_from.is_file():
        return
    errors = ("none", "simulated", *(["recorded"] if settings.recorded else []))
    for path in _sequences(settings.real):
        of_sequence = partial(MeasureDrives, path, surveyed_from, GATE_M)
        yield "found", of_sequence("alone", config=_of_one(OURS))
        for calibration, (config, boxes) in _KNOWN_TOO.items():
            place = _SEEN_FROM.get(path.name, _SEEN_FROM_ELSE) if boxes else (0.0, 0.0, 0.0)
            yield calibration, of_sequence("alone", seen_from=place, config=_of_one(config))
        for kind in errors:
            for crowd, config in (("passes", _of_one(OURS)), ("copies", OURS)):
                yield "found", of_sequence(crowd, kind, settings.recorded, config=config)


def _of_one(config: MapperConfig) -> MapperConfig:
    """A sign that one pass saw is a sign."""
    return replace(config, crowd=replace(config.crowd, min_journeys=1))


def _sequences(real: Path) -> list[Path]:
    folders = sorted(path.parent for path in real.glob("*/dataset.json"))
    if not folders:
        raise InputError(f"{real}: no dataset in it; expected folders with dataset.json")
    return folders


def _drives(settings: Settings, config: MapperConfig) -> list[MeasureReal]:
    if settings.real is None:
        return []
    folders = _sequences(settings.real)
    # There is one journey in each: what it saw alone is the map.
    eligible = settings.real / "eligible.json"
    return [MeasureReal(path, eligible, GATE_M, _of_one(config)) for path in folders]


STUDY = Study("real", "Real drives", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
