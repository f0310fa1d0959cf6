"""What a city's streets carry: markers from crossing to crossing, signs along them and at their corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from crowdmap_torch.simulate.markers import Markers, Strip, join_markers, lay_markers
from crowdmap_torch.simulate.signposts import (
    SignConfig,
    WorldSigns,
    join_signs,
    put_up_corner_post,
    put_up_signs,
)
from crowdmap_torch.simulate.street_grid import StreetGrid


def city_markers(grid: StreetGrid, *, dash_m: float, gap_m: float) -> Markers:
    """The markers of all streets, interrupted at crossings, with a stop line before each."""
    parts, width = [], grid.lane_width
    for block in grid.way:
        road, lanes = grid.road(grid.way[block]), grid.lanes_of(block)
        first, last = grid.gap(block, block[0]), road.length - grid.gap(block, block[1])
        strips = [Strip("double", (first, last), 0.0)]
        for side in (-1, 1):
            for k in range(1, lanes + 1):
                kind = "dashed" if k < lanes else "curb"
                strips.append(Strip(kind, (first, last), side * k * width, is_oncoming=side == 1))
            stop = last + 0.5 if side == -1 else first - 0.5
            strips.append(Strip("solid", (stop, stop), 0.0, side * lanes * width, crosses=True))
        laid = lay_markers(road, strips, dash_m=dash_m, gap_m=gap_m)
        # Ribbons are level across, the ground is not quite: all markers lie on the one ground.
        point = laid.point.copy()
        point[:, 2] = grid.height(point[:, :2])
        parts.append(replace(laid, point=point, station=np.full(len(laid), np.nan)))
    return join_markers(parts)


def city_signs(grid: StreetGrid, config: SignConfig, rng: np.random.Generator) -> WorldSigns:
    """The signs along all streets, and those at their corners."""
    parts = []
    for block in grid.way:
        road = grid.road(grid.way[block])
        side = grid.lanes_of(block) * grid.lane_width
        first, last = grid.gap(block, block[0]), road.length - grid.gap(block, block[1])
        parts.append(
            put_up_signs(
                road, config, rng, stations=(first, last), edges=(-side, side), lane_centres={}
            )
        )
        for direction, corner, station in ((1, block[1], last), (-1, block[0], first)):
            if rng.random() >= grid.config.corner_sign_share:
                continue
            gap = grid.gap(block, corner)
            gives_way = not grid.is_lit[corner] and gap > side + grid.lane_width
            offset = -direction * (side + rng.uniform(1.0, 2.0))
            parts.append(
                put_up_corner_post(
                    road,
                    config,
                    rng,
                    place=(station + direction * 1.0, offset),
                    direction=direction,
                    must_stop=gives_way,
                )
            )
    return join_signs(parts)
