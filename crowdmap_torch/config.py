"""The whole configuration: the stages' configs composed, read from strict YAML."""

from __future__ import annotations

import hashlib
import json
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import yaml

from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.crowd_lanes.cluster import LaneClusterConfig
from crowdmap_torch.crowd_lanes.join import LaneJoinConfig
from crowdmap_torch.crowd_signs.completion import CompleteTracksConfig
from crowdmap_torch.crowd_signs.duplicates import DuplicateSignConfig
from crowdmap_torch.crowd_signs.register import CrowdConfig
from crowdmap_torch.io.budget import ReadingBudget
from crowdmap_torch.io.documents import read_yaml_content
from crowdmap_torch.lanes.reconstruct import LaneConfig
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.ranges import Seed, Settings, Share, shown
from crowdmap_torch.residuals.sign_prior import SignHabit
from crowdmap_torch.road.estimate import RoadConfig
from crowdmap_torch.signs.pruning import SignTriangulationConfig
from crowdmap_torch.survey.control import ControlConfig
from crowdmap_torch.tracking.lane_features import LaneAssociationConfig
from crowdmap_torch.tracking.sign_features import SignAssociationConfig

Config = TypeVar("Config")

METHODS = ("joint", "paper2017")


@dataclass(frozen=True)
class MapperConfig(Settings):
    """Everything that can be set; a YAML file names only what differs from the defaults."""

    method: str = "joint"
    """`joint`: ours; `paper2017`: all of the paper's choices together, whatever the stages' own `method` says.

    How the paper regularises poses (V-B, footnote) it does not say: both have the same prior of them.
    """
    positioning: PositioningNoise = field(default_factory=PositioningNoise)
    """What the poses of every journey get wrong: all sections read it."""
    sign_association: SignAssociationConfig = field(default_factory=SignAssociationConfig)
    """IV-A, signs."""
    lane_association: LaneAssociationConfig = field(default_factory=LaneAssociationConfig)
    """IV-A, lanes."""
    sign_triangulation: SignTriangulationConfig = field(default_factory=SignTriangulationConfig)
    """IV-B."""
    road: RoadConfig = field(default_factory=RoadConfig)
    """IV-C."""
    lane: LaneConfig = field(default_factory=LaneConfig)
    """IV-D."""
    crowd: CrowdConfig = field(default_factory=CrowdConfig)
    """V-A and V-B: clustering and alignment of signs, repeated."""
    complete_tracks: CompleteTracksConfig = field(default_factory=CompleteTracksConfig)
    """V-A.1: detections that clustering set aside, given back to the signs they show."""
    duplicate_signs: DuplicateSignConfig = field(default_factory=DuplicateSignConfig)
    """V-B: signs of the adjusted map that are one."""
    lane_join: LaneJoinConfig = field(default_factory=LaneJoinConfig)
    """V-A: lanes of many journeys."""
    lane_cluster: LaneClusterConfig = field(default_factory=LaneClusterConfig)
    """V-A.2, with `method: paper2017`."""
    adjust: AdjustConfig = field(default_factory=AdjustConfig)
    """V-B: bundle adjustment."""
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    """What cars may have wrong for good: unknowns of the adjustment."""
    control: ControlConfig = field(default_factory=ControlConfig)
    """Surveyed signs that pin the map: which of the map's they are."""
    seed: Seed = 0
    """Of k-means; the same seed and data give the same map."""
    min_confidence: Share = 0.5
    """Signs below this go to tentative_signs.parquet."""
    reading: ReadingBudget = field(default_factory=ReadingBudget)
    """The most that one file of the dataset may ask for."""

    def __post_init__(self) -> None:
        """Refuses an unknown method."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, found {self.method!r}")

    def resolved(self) -> MapperConfig:
        """The configuration with the paper's choices in every stage, if that is the method of all."""
        if self.method != "paper2017":
            return self
        return replace(
            self,
            sign_association=replace(self.sign_association, method="paper2017"),
            lane_association=replace(self.lane_association, method="paper2017"),
            sign_triangulation=replace(self.sign_triangulation, method="paper2017"),
            road=replace(self.road, method="paper2017"),
            lane=replace(self.lane, method="paper2017"),
            crowd=replace(self.crowd, method="paper2017"),
            # eq:ba knows neither boxes nor what signs are like, nor a road under its lanes.
            adjust=replace(
                self.adjust,
                method="paper2017",
                box_sigma=0.0,
                habit=SignHabit(facing_rad=math.inf, upright_rad=math.inf, log_size=math.inf),
                lane_height_sigma_m=math.inf,
            ),
            calibration=CalibrationConfig.off(),
        )


def load_config(path: Path | str | None) -> MapperConfig:
    """The configuration of a YAML file, or the defaults; ValueError names the file, the key and what was expected."""
    if path is None:
        return MapperConfig()
    path = Path(path)
    content = read_yaml_content(path)
    return changed(MapperConfig(), {} if content is None else content, where=str(path))


def changed(default: Config, content: Any, *, where: str) -> Config:
    """The config dataclass `default` with what nested mappings say.

    An unknown key or a value of the wrong type is a ValueError.
    """
    if not isinstance(content, Mapping):
        raise ValueError(f"{where}: expected keys and values, found {shown(content)}")
    known = {f.name for f in fields(default)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(type(default))
    given = {}
    for key, value in content.items():
        if key not in known:
            raise ValueError(
                f"{where}: unknown key {shown(key)}; expected one of {', '.join(sorted(known))}"
            )
        here = f"{where}: {key}"
        # A stage may start from other defaults than those of the class of its field: they stay.
        inner = getattr(default, key)
        given[key] = (
            changed(inner, value, where=here)
            if is_dataclass(inner)
            else _value(hints[key], value, where=here)
        )
    try:
        return replace(default, **given)  # type: ignore[type-var]
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def as_dict(config: MapperConfig) -> dict[str, Any]:
    """The configuration as nested plain values, defaults filled in."""
    return json.loads(json.dumps(asdict(config)))


@lru_cache(maxsize=4)
def dump(config: MapperConfig) -> str:
    """The configuration as YAML, defaults filled in."""
    return yaml.safe_dump(as_dict(config), sort_keys=False)


@lru_cache(maxsize=64)
def config_hash(config: MapperConfig) -> str:
    """Twelve hex digits that differ where configurations differ."""
    text = json.dumps(as_dict(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _value(hint: Any, value: Any, *, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _value(next(a for a in arguments if a is not type(None)), value, where=where)
    if origin is tuple:
        if not isinstance(value, list):
            raise ValueError(f"{where}: expected a list, found {shown(value)}")
        endless = len(arguments) == 2 and arguments[1] is Ellipsis
        kinds = [arguments[0]] * len(value) if endless else list(arguments)
        if len(kinds) != len(value):
            raise ValueError(f"{where}: expected {len(kinds)} values, found {len(value)}")
        return tuple(
            _value(kind, item, where=f"{where}[{i}]")
            for i, (kind, item) in enumerate(zip(kinds, value, strict=True))
        )
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise ValueError(f"{where}: expected a number, found {shown(value)}") from None
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        raise ValueError(f"{where}: expected {hint.__name__}, found {shown(value)}")
    return value
