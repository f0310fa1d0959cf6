"""Drives where they lie: what a worker is told in place of a drive's tables, and reads them by."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from crowdmap_torch.io.area import Area, cut_journey
from crowdmap_torch.io.budget import ReadingBudget, reading
from crowdmap_torch.io.datasets import load_journey, recoded
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.remote import Place, at_hand
from crowdmap_torch.io.trees import digest
from crowdmap_torch.tables import Dataset, Journey


@dataclass(frozen=True)
class StoredDrive:
    """One drive of a dataset, as it was read and cut where the work was handed out."""

    dataset: Place
    """Its folder, from the root, or its URL: workers may be elsewhere."""
    journey_id: str
    type_names: tuple[str, ...]
    """What the `type` column of signs counts."""
    bbox: tuple[float, float, float, float] | None
    """What the dataset was cut to."""
    budget: ReadingBudget
    digest: str
    """Of the drive."""

    def read(self) -> Journey:
        """The drive; InputError if it is not what it was, or not to be found here."""
        with reading(self.budget), at_hand(self.dataset, [self.journey_id], survey=False) as here:
            return self._read(here)

    def _read(self, dataset: Path) -> Journey:
        folder = dataset / "journeys" / self.journey_id
        if not folder.is_dir():
            raise InputError(
                f"{folder}: is not there on {platform.node()}; workers read their drives themselves, every machine "
                "needs the dataset at the same place"
            )
        journey, own = load_journey(folder)
        journey = recoded(journey, own, self.type_names)
        if self.bbox is not None:
            journey = cut_journey(journey, Area(*self.bbox))
        if digest(journey) != self.digest:
            raise InputError(
                f"{folder}: has changed since the run was started; start it again, with --overwrite"
            )
        return journey


def stored_drives(
    place: Place, dataset: Dataset, digests: Mapping[str, str], budget: ReadingBudget
) -> tuple[StoredDrive, ...]:
    """The drives of a dataset that was read from a place within a budget; `digests` are those of the journeys, by id."""
    return tuple(
        StoredDrive(
            dataset=place.absolute() if isinstance(place, Path) else place,
            journey_id=journey.journey_id,
            type_names=dataset.type_names,
            bbox=dataset.bbox,
            budget=budget,
            digest=digests[journey.journey_id],
        )
        for journey in dataset.journeys
    )
