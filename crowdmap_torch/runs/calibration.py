"""What a run found of its cars: calibration.json and rigs/ of FORMAT.md, and what an earlier run found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path

from crowdmap_torch.adjustment.calibration import VARIABLES
from crowdmap_torch.adjustment.found_calibration import FleetCalibration
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.found_calibration import (
    read_calibration,
    write_calibration,
    write_corrected_rigs,
)
from crowdmap_torch.io.rigs import refuse_unreadable
from crowdmap_torch.noise.calibration import KnownCalibration, corrected_rig
from crowdmap_torch.tables import Dataset, Journey, Rig

_FILE = "calibration.json"


def write_found(folder: Path, dataset: Dataset, found: FleetCalibration) -> None:
    """calibration.json, and for every car its rig put right; nothing where calibrations were not asked."""
    if not found:
        return
    journeys = Counter(journey.vehicle for journey in dataset.journeys)
    rig_of = _rigs(dataset.journeys)
    cars = {}
    for name, car in found.items():
        parts = asdict(car)
        parameters = {
            key: {
                **{part: list(parts[part][key]) for part in ("estimate", "sigma", "prior_sigma")},
                "observability": [1 - ratio for ratio in car.ratio(key)],
            }
            for key in car.estimate
        }
        cars[name] = {
            "rig": rig_of[name].rig_id,
            "journeys": journeys[name],
            "parameters": parameters,
            "unseen": list(car.unseen),
            "confounded": [list(pair) for pair in car.confounded],
        }
    write_calibration(folder / _FILE, cars)
    rigs = [
        (
            name,
            corrected_rig(rig_of[name], {k: (car.estimate[k], car.sigma[k]) for k in car.estimate}),
        )
        for name, car in found.items()
    ]
    write_corrected_rigs(folder / "rigs", rigs)


def read_found(run: Path, journeys: Sequence[Journey]) -> dict[str, KnownCalibration]:
    """What the run in a folder found of its cars.

    InputError where there is no such run, it asked for no calibration, or what it found makes no rig of one of the
    cars of `journeys`.
    """
    path = run / _FILE
    if not path.exists():
        raise InputError(
            f"--calibration {run}: expected a run with {_FILE} in it, or off; none is there"
        )
    found = read_calibration(path)
    for car, numbers in found.items():
        for one in chain(*VARIABLES.values()):
            count = len(numbers[one.name][0]) if one.name in numbers else one.count
            if count != one.count:
                raise InputError(
                    f"{path}: cars.{car}.parameters.{one.name}: expected {one.count} numbers, found {count}"
                )
    for car, rig in _rigs(journeys).items():
        if car in found:
            refuse_unreadable(corrected_rig(rig, found[car]), path, f"cars.{car}, rig put right")
    return found


def _rigs(journeys: Sequence[Journey]) -> dict[str, Rig]:
    """The stated rig of every car: that of its first journey."""
    return {journey.vehicle: journey.rig for journey in reversed(journeys)}
