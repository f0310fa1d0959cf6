"""A tiny dataset as plain Python columns: a test spoils what it wants to, then writes it."""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import yaml

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import ControlPoints, HdMap, Lanes, Origin, Signs

NUMBERS = pa.list_(pa.float32())
TYPES = {
    "frame": pa.int64(),
    "t_ns": pa.int64(),
    "shape": pa.string(),
    "type": pa.string(),
    "u": NUMBERS,
    "v": NUMBERS,
    "track": pa.int64(),
    "score": pa.float32(),
}
ORIGIN = {"lat_deg": 32.9, "lon_deg": -117.2, "height_m": 120.0}

POSES: dict[str, list] = {
    "frame": [10, 11, 13, 14],
    "t_ns": [1_000_000_000 + 66_000_000 * k for k in range(4)],
    "x": [0.0, 1.0, 2.0, 3.0],
    "y": [0.0, 0.1, 0.2, 0.3],
    "z": [0.0, 0.0, 0.0, 0.0],
    "qx": [-0.5] * 4,
    "qy": [0.5] * 4,
    "qz": [-0.5] * 4,
    "qw": [0.5] * 4,
}
SIGNS: dict[str, list] = {
    "frame": [13, 10, 10],
    "shape": ["rectangle", "triangle", "octagon"],
    "u": [
        [30.0, 50.0, 50.0, 30.0],
        [80.0, 90.0, 70.0],
        [104.0, 108.0, 111.0, 111.0, 108.0, 104.0, 101.0, 101.0],
    ],
    "v": [
        [20.0, 20.0, 30.0, 30.0],
        [20.0, 40.0, 40.0],
        [11.0, 11.0, 14.0, 18.0, 21.0, 21.0, 18.0, 14.0],
    ],
    "type": ["US:R1-1", None, "DE:274"],
    "score": [0.9, None, 1.0],
    "track": [7, None, 8],
}
LANES: dict[str, list] = {
    "frame": [14, 10],
    "u": [[60.0, 40.0, 20.0], [70.0, 90.0]],
    "v": [[50.0, 60.0, 79.0], [50.0, 75.0]],
    "type": ["solid", None],
    "score": [None, 0.25],
}
RIG: dict[str, Any] = {
    "camera": {
        "model": "brown_conrady",
        "width": 120,
        "height": 80,
        "fx": 100.0,
        "fy": 100.0,
        "cx": 59.5,
        "cy": 39.5,
        "distortion": [],
    },
    "road": {"normal": [0.0, 1.0, 0.0], "height_m": 1.45},
}
URDF = """<?xml version="1.0" encoding="UTF-8"?>
<robot name="car">
  <link name="base_link"/><link name="camera_optical"/>
  <joint name="mount" type="fixed">
    <parent link="base_link"/><child link="camera_optical"/>
    <origin xyz="1.5 0.1 1.4" rpy="-1.5707963267948966 0 -1.5707963267948966"/>
  </joint>
</robot>
"""
MOUNT = {"urdf": "rig.urdf", "pose_link": "base_link", "camera_link": "camera_optical"}


@dataclass
class TinyJourney:
    """The files of one journey; a file that is None is not written, bytes are written as they are."""

    head: Any
    poses: Any = field(default_factory=lambda: copy.deepcopy(POSES))
    signs: Any = field(default_factory=lambda: copy.deepcopy(SIGNS))
    lanes: Any = field(default_factory=lambda: copy.deepcopy(LANES))


@dataclass
class TinyDataset:
    """The files of a dataset with two journeys, `a` and `b`, each with its own rig of the same name."""

    folder: Path
    head: Any
    rigs: dict[str, Any]
    urdfs: dict[str, str]
    journeys: dict[str, TinyJourney]

    def write(self) -> Path:
        """Writes everything and returns the folder."""
        self.folder.mkdir(exist_ok=True)
        write_text(self.folder / "dataset.json", self.head, json.dumps)
        for name, rig in self.rigs.items():
            write_text(self.folder / "rigs" / name / "rig.yaml", rig, yaml.safe_dump)
        for name, urdf in self.urdfs.items():
            write_text(self.folder / "rigs" / name / "rig.urdf", urdf, str)
        for name, journey in self.journeys.items():
            folder = self.folder / "journeys" / name
            folder.mkdir(parents=True, exist_ok=True)
            write_text(folder / "journey.json", journey.head, json.dumps)
            for file in ("poses", "signs", "lanes"):
                write_table(folder / f"{file}.parquet", getattr(journey, file))
        return self.folder


def write_text(path: Path, content: Any, dump: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content, encoding="utf-8")
    elif content is not None:
        path.write_text(dump(content), encoding="utf-8")


def write_table(path: Path, content: Any) -> None:
    """A file of bytes, or of columns: lists get the type of FORMAT.md, arrow arrays keep their own."""
    if content is None:
        return
    if isinstance(content, bytes):
        path.write_bytes(content)
        return
    columns = {
        name: pa.array(values, TYPES.get(name, pa.float64()))
        if isinstance(values, list)
        else values
        for name, values in content.items()
    }
    pq.write_table(pa.table(columns), path)


@pytest.fixture
def sound(tmp_path: Path) -> TinyDataset:
    """A sound dataset, not written yet; the rig `a` has a mount, `b` has none."""
    names = ("a", "b")
    rigs = {name: copy.deepcopy(RIG) for name in names}
    rigs["a"]["mount"] = dict(MOUNT)
    heads = {
        name: {"format": "crowdmap-journey", "version": 1, "journey_id": name, "rig": name}
        for name in names
    }
    journeys = {name: TinyJourney(heads[name]) for name in names}
    for detections in (journeys["a"].signs, journeys["a"].lanes):
        # Two drives never have the same outlines.
        detections["v"] = [[v + 0.25 for v in row] for row in detections["v"]]
    return TinyDataset(
        folder=tmp_path / "dataset",
        head={"format": "crowdmap-dataset", "version": 1, "origin": dict(ORIGIN)},
        rigs=rigs,
        urdfs={"a": URDF},
        journeys=journeys,
    )


@pytest.fixture
def hd_map(generator) -> HdMap:
    """One sign of every shape, upright within a few degrees, and two lane pieces."""
    n = len(polygon.SHAPES)
    # Faces west: x to the north's right hand (south), y up, z to the west.
    R = torch.tensor([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    tilt = 0.05 * torch.randn(n, 3, dtype=torch.float64, generator=generator)
    p = 50 * torch.randn(n, 3, dtype=torch.float64, generator=generator)
    A = torch.randn(n, 3, 3, dtype=torch.float64, generator=generator)
    support = torch.arange(n)
    none = torch.full((n,), -1)
    confidence = torch.full((n,), 0.7, dtype=torch.float64)
    confidence[:5] = torch.tensor([0.9, 0.4, 1.0, 0.5, 0.0])
    signs = Signs(
        shape=support,
        type=torch.tensor([0, -1, 1]).repeat(n)[:n],
        T_world_sign=se3.make(R @ se3.so3_exp(tilt), p),
        size=0.5 + torch.rand(n, 2, dtype=torch.float64, generator=generator),
        covariance=A @ A.mT,
        journey=none,
        tracklet=none,
        frame=none,
        n_journeys=support + 3,
        n_observations=support + 30,
        first_seen_ns=support + 10**18,
        last_seen_ns=support + 2 * 10**18,
        confidence=confidence,
    )
    station = torch.linspace(0, 1, 7, dtype=torch.float64)[:, None]
    curve = torch.cat((30 * station, 4 * station.square(), 0.3 * station), dim=-1)
    lanes = Lanes(
        type=torch.tensor([1, -1]),
        control_start=torch.tensor([2, 0]),
        control_count=torch.tensor([5, 2]),
        journey=none[:2],
        tracklet=none[:2],
        frame=none[:2],
        n_journeys=torch.tensor([3, 4]),
        n_observations=torch.tensor([300, 400]),
        first_seen_ns=torch.tensor([1, 2]),
        last_seen_ns=torch.tensor([3, 4]),
        confidence=torch.tensor([0.9, 0.8], dtype=torch.float64),
        control=ControlPoints(point_world=curve, sigma=0.01 + station[:, 0]),
    )
    return HdMap(
        origin=Origin(32.9, -117.2, 120.0),
        signs=signs,
        lanes=lanes,
        sign_id=tuple(f"s{k}" for k in range(n)),
        lane_id=("l0", "l1"),
        type_names=("DE:274", "US:R1-1"),
        shared_covariance=0.1 * torch.eye(3, dtype=torch.float64),
        provenance={"version": "0.1.0", "journeys": ["a", "b"]},
    )
