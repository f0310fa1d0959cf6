"""The folder of a study: what was simulated, mapped and measured before, and is not done again."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.io.documents import write_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.mapper import JourneyMap
from crowdmap_torch.simulate.dataset import SimulationConfig

_JOURNEY_PART = (
    "positioning",
    "sign_association",
    "lane_association",
    "sign_triangulation",
    "road",
    "lane",
)
"""What a configuration says of single journeys: those with these alike share the maps of their journeys."""


class StudyFolder:
    """Simulated datasets, maps of single journeys, and one JSON for each thing measured.

    Every name holds a hash of all the settings that decide the content. It does not know the code: after a change of
    the code begin another folder.
    """

    def __init__(self, path: Path) -> None:
        """InputError if `path` is a file."""
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is a file; --out names a folder")
        self.path = path

    def dataset(self, simulation: SimulationConfig) -> Path:
        """Where the dataset of these settings is."""
        return self.path / "datasets" / dataset_name(simulation)

    def has_result(self, key: str) -> bool:
        """True if this was measured."""
        return self._result(key).exists()

    def read_result(self, key: str) -> dict[str, Any]:
        """What was measured."""
        return json.loads(self._result(key).read_text(encoding="utf-8"))

    def write_result(self, key: str, measured: Mapping[str, Any]) -> None:
        """Keeps what was measured, complete or not at all."""
        write_json(self._result(key), dict(measured))

    def read_journey_map(self, key: str) -> JourneyMap:
        """The map of a single journey."""
        return pickle.loads(self._journey_map(key).read_bytes())

    def write_journey_map(self, key: str, journey_map: JourneyMap) -> None:
        """Keeps the map of a single journey, complete or not at all."""
        with atomic_file(self._journey_map(key)) as beside:
            beside.write_bytes(pickle.dumps(journey_map))

    def _result(self, key: str) -> Path:
        return self.path / "results" / f"{key}.json"

    def _journey_map(self, key: str) -> Path:
        return self.path / "journeys" / f"{key}.pickle"


@cache
def dataset_name(simulation: SimulationConfig) -> str:
    """A name that differs where datasets differ."""
    return f"{simulation.world.name}-{simulation.seed}-{digest(asdict(simulation))}"


@cache
def journey_config_hash(config: MapperConfig) -> str:
    """Digits that differ where single journeys are mapped differently."""
    settings = asdict(config.resolved())
    return digest({part: settings[part] for part in _JOURNEY_PART})


def digest(settings: Mapping[str, Any]) -> str:
    """Twelve hex digits that differ where settings differ."""
    text = json.dumps(settings, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
