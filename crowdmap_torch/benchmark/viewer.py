"""The page of `crowdmap view` in a browser without a window: how long it takes to open, how many pictures a second it draws.

By default 10 km with five markers, 1,000 signs and 25 drives, before and after the adjustment, and their survey.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.benchmark.browser import Page, browser
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.errors import InputError, input_read
from crowdmap_torch.tables import (
    LANE_TYPES,
    ControlPoints,
    HdMap,
    Lanes,
    Origin,
    Signs,
    Survey,
    SurveyLanePoints,
    SurveySigns,
)
from crowdmap_torch.viewer.page import write_page
from crowdmap_torch.viewer.scene import Drive, Scene
from crowdmap_torch.viewer.sources import read_scene

LENGTH_M, SIGNS, DRIVES = 10_000, 1_000, 25
_V = "document.querySelector('.cmv').viewer"
_LOOKS = {
    "all of it": "v.home()",
    "from above, 4 px a metre": "v.view.look(s.x, s.y, s.z, 4)",
    "from above, 14 px a metre": "v.view.look(s.x, s.y, s.z, 14)",
    "3D, far": "tilt(0.5, 3)",
    "3D, near": "tilt(0.25, 25)",
    "3D, on the street": "tilt(0.08, 90)",
}
"""What is looked at: the middle one of the signs, as its driver comes."""
_PAN = """(async () => {
  const times = [], draws = [];
  let last = 0;
  for (let k = 0; k < %d; k++) {
    await new Promise(requestAnimationFrame);
    const now = performance.now();
    if (last) times.push(now - last);
    last = now;
    v.view.pan(k %% 20 < 10 ? 9 : -9, k %% 2 ? 3 : -3);
    v.now();
    draws.push(performance.now() - now);
  }
  const middle = (list) => list.sort((a, b) => a - b)[list.length >> 1];
  return [middle(times), middle(draws)];
})()"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap benchmark viewer` takes."""
    parser.add_argument(
        "path", type=Path, nargs="?", metavar="MAP|RUN|DATASET", help="default: 10 km made up"
    )
    parser.add_argument("--frames", type=int, default=120, help="pictures of each look")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="keep one of each, as PNG")


def run(options: argparse.Namespace) -> None:
    """Prints the table."""
    with input_read():
        scene = long_road() if options.path is None else read_scene(options.path)
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        path = Path(scratch) / "view.html"
        write_page(path, scene)
        kilobytes = path.stat().st_size / 1000
        try:
            with browser(Path(scratch) / "browser") as page:
                page.resize(1200, 800)
                page.open(path)
                ready = page.ask("document.querySelector('.cmv').dataset.ready")
                load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
                print(f"{kilobytes:.0f} kB, open after {ready} ms, {load}")
                print(f"{'look':<28}{'pictures/s':>12}{'ms to draw':>12}")
                for name, look in _LOOKS.items():
                    interval, draw = _pan(page, look, options.frames)
                    print(f"{name:<28}{1000 / interval:>12.0f}{draw:>12.2f}", flush=True)
                    if options.pictures is not None:
                        page.picture(options.pictures / f"{name.replace(',', '')}.png")
        except RuntimeError as error:
            raise InputError(str(error)) from error


def _pan(page: Page, look: str, frames: int) -> tuple[float, float]:
    """Milliseconds between two pictures, and those of drawing one, in the median, moved as a hand would."""
    begin = (
        f"const v = {_V}, m = v.model, s = (m.signs.length ? m.signs : m.survey)[m.signs.length >> 1] || v.view;"
        "const tilt = (pitch, scale) => { const n = s.axes ? s.axes[2] : [0, -1]; v.view.solid = true;"
        " v.view.pitch = pitch; v.view.turn = Math.atan2(n[0], -n[1]) - 0.2; v.view.look(s.x, s.y, s.z, scale); };"
    )
    page.ask(
        f"{{ {begin} v.view.solid = false; v.view.turn = 0; {look}; v.view.update(); v.now(); }}"
    )
    # The first pictures compile the code.
    page.ask(f"(async () => {{ const v = {_V}; return await {_PAN % 30}; }})()")
    interval, draw = page.ask(
        f"(async () => {{ const v = {_V}; return await {_PAN % frames}; }})()"
    )
    return interval, draw


def long_road() -> Scene:
    """Ten kilometres that wind, with signs on both sides."""
    generator = torch.Generator().manual_seed(0)
    lines = [_line(y) for y in (-7.0, -3.5, 0.0, 3.5, 7.0)]
    control, count = torch.cat(lines), torch.tensor([len(line) for line in lines])
    kinds = [LANE_TYPES.index(name) for name in ("solid", "dashed", "double", "dashed", "solid")]
    lanes = Lanes(
        type=torch.tensor(kinds),
        control_start=count.cumsum(0) - count,
        control_count=count,
        control=ControlPoints(control, torch.full_like(control[:, 0], 0.05)),
        **_seen(len(lines)),
    )
    signs = _signs()
    noise = 0.1 * torch.randn(SIGNS, 3, generator=generator, dtype=torch.float64)
    hd_map = HdMap(
        origin=Origin(32.9, -117.2, 120.0),
        signs=signs,
        lanes=lanes,
        sign_id=tuple(f"sign-{k}" for k in range(SIGNS)),
        lane_id=tuple(f"lane-{k}" for k in range(len(lines))),
        type_names=tuple(f"US:R{k}-1" for k in range(7)),
        shared_covariance=1e-3 * torch.eye(3, dtype=torch.float64),
        provenance={},
    )
    survey = Survey(
        origin=hd_map.origin,
        sign_id=hd_map.sign_id,
        signs=SurveySigns(
            shape=signs.shape,
            corners_world=signs.corners_world + noise[:, None],
            center_world=signs.center_world + noise,
            normal_world=signs.normal_world,
            sigma=torch.full((SIGNS,), 0.02, dtype=torch.float64),
        ),
        lane_id=hd_map.lane_id,
        lane_type=lanes.type,
        lane_points=SurveyLanePoints(lanes.piece_of_control, control),
    )
    return Scene(
        kind="run",
        title="10 km",
        origin=hd_map.origin,
        hd_map=hd_map,
        map_before=replace(hd_map, signs=_moved(signs, 3 * noise)),
        survey=survey,
        drives=tuple(_drive(k) for k in range(DRIVES)),
    )


def _line(left: float) -> Float[Tensor, "p 3"]:
    x = torch.linspace(0, LENGTH_M, LENGTH_M // 5 + 1, dtype=torch.float64)
    return torch.stack((x, 300 * (x / 900).sin() + left, 2 * (x / 400).sin()), dim=-1)


def _signs() -> Signs:
    number = torch.arange(SIGNS)
    x = torch.linspace(5, LENGTH_M - 5, SIGNS, dtype=torch.float64)
    right = number % 2 == 0
    y = 300 * (x / 900).sin() + torch.where(right, -9.0, 9.0)
    center = torch.stack((x, y, 2 * (x / 400).sin() + 2.3), dim=-1)
    # Those on the right face those who drive east.
    normal = torch.zeros(SIGNS, 3, dtype=torch.float64)
    normal[:, 0] = torch.where(right, -1.0, 1.0)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(SIGNS, 3)
    R = torch.stack((torch.linalg.cross(up, normal), up, normal), dim=-1)
    return Signs(
        shape=number % len(polygon.SHAPES),
        type=number % 7,
        T_world_sign=se3.make(R, center),
        size=torch.full((SIGNS, 2), 0.75, dtype=torch.float64),
        covariance=0.05**2 * torch.eye(3, dtype=torch.float64).expand(SIGNS, 3, 3),
        **_seen(SIGNS),
    )


def _seen(count: int) -> dict[str, Tensor]:
    """What signs and lanes of a map have in common."""
    none, some = torch.full((count,), -1), torch.full((count,), 25)
    return {
        "journey": none,
        "tracklet": none,
        "frame": none,
        "n_journeys": some,
        "n_observations": 20 * some,
        "first_seen_ns": torch.zeros(count, dtype=torch.int64),
        "last_seen_ns": torch.ones(count, dtype=torch.int64),
        "confidence": torch.ones(count, dtype=torch.float64),
    }


def _moved(signs: Signs, away: Float[Tensor, "n 3"]) -> Signs:
    T = signs.T_world_sign.clone()
    T[:, :3, 3] += away
    return replace(signs, T_world_sign=T)


def _drive(number: int) -> Drive:
    path = _line(0.2 * number - 3)
    frame = torch.arange(len(path))
    given = _line(0.2 * number - 2.5)
    return Drive(f"drive-{number}", frame, frame * 10**8, path, given, bias=(0.0, -0.5, 0.0))
