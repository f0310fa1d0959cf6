from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch

if TYPE_CHECKING:
    from worlds.small_world import Builder

    from crowdmap_torch.mapper import MapResult
    from crowdmap_torch.tables import Dataset
    from crowdmap_torch.viewer.scene import Scene


@pytest.fixture(scope="session")
def scene(build: Builder) -> Scene:
    """A run with something in every part of the viewer, ids and codes as wicked as they may be."""
    from crowdmap_torch.geometry import polygon
    from crowdmap_torch.io.sign_outcomes import NamedOutcomes, SignOutcomes
    from crowdmap_torch.viewer.scene import Drive, Scene

    k = torch.arange(9, dtype=torch.float64)
    true = build.signs(
        torch.stack((12 * k, 4 * (-1) ** k, 2 + 0.1 * k), dim=-1), shape=k.long() % 6
    )
    lines = [build.straight(y) for y in (0.0, 3.5)]
    generator = torch.Generator().manual_seed(3)
    noise = 0.05 * torch.randn(9, 3, generator=generator, dtype=torch.float64)
    hd_map = build.hd_map(build.moved(true, noise), build.lanes(lines), shared=0.05)
    wicked = ("</script><b>", "a&b", *(f"s{i}" for i in range(7)))
    hd_map = replace(hd_map, sign_id=wicked)
    drives = tuple(
        Drive(
            journey_id=name,
            frame_number=torch.arange(100, 111),
            t_ns=10**18 + torch.arange(11) * 10**8,
            path_world=build.straight(y),
            given_world=build.straight(y + 0.4),
            vehicle="car",
            image=(1280, 800),
            bias=(0.0, -0.4, 0.1),
            bias_sigma=(0.1, 0.1, 0.2),
        )
        for name, y in (("<i>drive", 1.5), ("other", 1.8))
    )
    count = 60
    of, shape = torch.arange(count) % 9, k.long()[torch.arange(count) % 9] % 6
    corners = 600 + 40 * polygon.pad(polygon.template(shape), polygon.corner_count(shape))
    residual = torch.full_like(corners, 0.5)
    residual[::7] = torch.nan
    rows = SignOutcomes(
        journey=torch.arange(count) % 2,
        row=torch.arange(count),
        frame=100 + torch.arange(count) // 6,
        shape=shape,
        fate=(torch.arange(count) % 7 == 0).long(),
        sign=torch.where(torch.arange(count) % 7 == 0, -1, of),
        near_sign=torch.where(torch.arange(count) % 7 == 0, of, -1),
        given_up=torch.arange(count) % 11 == 1,
        corners_px=corners,
        residual_px=residual,
    )
    ids = tuple(drive.journey_id for drive in drives)
    return Scene(
        kind="run",
        title="</title><script>alert(1)</script>",
        origin=hd_map.origin,
        hd_map=hd_map,
        map_before=build.hd_map(build.moved(true, 3 * noise), build.lanes(lines)),
        survey=build.survey(true, lines),
        drives=drives,
        outcomes=NamedOutcomes(rows, ids, ("in the map", "in no track"), wicked),
        notes=("a <note>",),
    )


@pytest.fixture(scope="session")
def run_folder(
    tmp_path_factory: pytest.TempPathFactory,
    tiny_folder: Path,
    tiny: Dataset,
    tiny_result: MapResult,
) -> Path:
    """What the main job writes of the tiny data set."""
    from crowdmap_torch import mapper
    from crowdmap_torch.config import MapperConfig
    from crowdmap_torch.report.outcomes import sign_outcomes
    from crowdmap_torch.report.progress import Progress
    from crowdmap_torch.runs.folder import RunFolder
    from crowdmap_torch.runs.metrics import metrics_of

    config, result = MapperConfig(), tiny_result
    bundle = mapper.build_bundle(tiny.journeys, result.journey_maps, result.first, config)
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "run")
    with folder.claimed():
        folder.prepare(tiny_folder)
        folder.write_result(tiny, result, config)
        with folder.publishing():
            folder.write_metrics(metrics_of(tiny, result, config, (), Progress(), {}, None, None))
            folder.keep_outcomes(sign_outcomes(tiny, result, bundle, config))
    return folder.path
