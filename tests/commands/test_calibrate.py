from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from worlds.garage import FLOOR, HEIGHT, NORMAL, PLACES, RIG, WALL, camera_pose, write_garage

from crowdmap_torch.cli import main
from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import project
from crowdmap_torch.io.rigs import read_rig

F64 = torch.float64


@pytest.fixture
def garage(tmp_path: Path) -> Path:
    """A rig, and tables of exact pixels."""
    return write_garage(tmp_path)


def run(garage: Path, *more: str) -> int:
    tables = ["--points", str(garage / "points.csv"), "--pixels", str(garage / "pixels.csv")]
    return main(["calibrate", str(garage / "rig-a"), *tables, *more])


def off_deg(normal: torch.Tensor) -> float:
    return math.degrees(float(torch.linalg.cross(normal, NORMAL).norm()))


def with_noise(garage: Path, sigma_px: float, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    rows = list(csv.DictReader((garage / "pixels.csv").open()))
    with (garage / "pixels.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        for row in rows:
            moved = {k: float(row[k]) + sigma_px * rng.normal() for k in ("u", "v")}
            writer.writerow({**row, **moved})


def test_exact_pixels_give_the_exact_road(garage: Path, capsys) -> None:
    assert run(garage) == 0
    rig = read_rig(garage / "rig-a")
    assert off_deg(rig.road_normal_camera) < 1e-4
    assert rig.camera_height == pytest.approx(HEIGHT, abs=1e-5)
    assert "img3" in capsys.readouterr().out


def test_several_noisy_pictures_are_averaged(garage: Path) -> None:
    with_noise(garage, 0.3)
    assert run(garage) == 0
    rig = read_rig(garage / "rig-a")
    assert off_deg(rig.road_normal_camera) < 0.1
    assert rig.camera_height == pytest.approx(HEIGHT, abs=0.01)


def test_the_rest_of_rig_yaml_stays_as_it_is(garage: Path) -> None:
    assert run(garage) == 0
    text = (garage / "rig-a" / "rig.yaml").read_text()
    before, after = RIG.split("road:")[0], "# poses are the camera's own\n"
    assert text.startswith(before) and text.endswith(after)
    assert text.count("road:") == 1 and "a guess" not in text
    # And again over its own result.
    assert run(garage) == 0
    assert (garage / "rig-a" / "rig.yaml").read_text() == text


def test_a_rig_without_a_road_gets_one(garage: Path) -> None:
    (garage / "rig-a" / "rig.yaml").write_text(RIG.split("road:")[0].rstrip("\n"))
    assert run(garage) == 0
    assert off_deg(read_rig(garage / "rig-a").road_normal_camera) < 1e-4


def test_dry_run_writes_nothing(garage: Path) -> None:
    assert run(garage, "--dry-run") == 0
    assert (garage / "rig-a" / "rig.yaml").read_text() == RIG


def test_tables_can_be_yaml(garage: Path) -> None:
    for name in ("points", "pixels"):
        rows = list(csv.DictReader((garage / f"{name}.csv").open()))
        typed = [
            {k: float(v) if k in ("x", "y", "z", "u", "v") else v for k, v in row.items()}
            for row in rows
        ]
        (garage / f"{name}.yaml").write_text(yaml.safe_dump({name: typed}))
    tables = ["--points", str(garage / "points.yaml"), "--pixels", str(garage / "pixels.yaml")]
    assert main(["calibrate", str(garage / "rig-a"), *tables]) == 0
    assert off_deg(read_rig(garage / "rig-a").road_normal_camera) < 1e-4


def change(name: str, old: str, new: str, *, count: int = -1) -> Callable[[Path], object]:
    def apply(garage: Path) -> None:
        path = garage / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, count))

    return apply


def only(name: str, starts: tuple[str, ...]) -> Callable[[Path], object]:
    def apply(garage: Path) -> None:
        lines = (garage / name).read_text().splitlines()
        kept = [lines[0], *(x for x in lines[1:] if x.startswith(starts))]
        (garage / name).write_text("\n".join(kept) + "\n")

    return apply


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda g: (g / "points.csv").unlink(), "the file is missing"),
        (change("points.csv", "surface", "kind"), "column 'surface' is missing"),
        (change("points.csv", ",floor", ",ceiling"), "expected one of wall, floor"),
        (change("points.csv", "w1,", "w0,"), "point 'w0' is given twice"),
        (change("pixels.csv", "img0,w0,", "img0,x9,"), "'x9' is not among the surveyed ones"),
        (change("pixels.csv", "img0,w1,", "img0,w0,"), "given twice in picture 'img0'"),
        (change("pixels.csv", "img0,w0,", "img0,w0,nan"), "expected a finite number"),
        (change("pixels.csv", "img0,w0,", "img0,w0,1"), "its points miss by"),
        (only("pixels.csv", ("img0,w0", "img0,w1", "img0,w2", "img0,w3")), "4 points; expected 6"),
        (only("points.csv", ("w",)), "is not among the surveyed ones"),
        (only("pixels.csv", ("nothing",)), "no rows"),
        (change("rig-a/rig.yaml", "fx: 1000.0", "fx: -1.0"), "expected a number in 1 to"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(
    garage: Path, capsys, spoil: Callable[[Path], object], says: str
) -> None:
    spoil(garage)
    before = (garage / "rig-a" / "rig.yaml").read_text()
    assert run(garage) == 2
    error = capsys.readouterr().err
    assert error.startswith("crowdmap calibrate: ") and error.count("\n") == 1
    assert says in error
    assert (garage / "rig-a" / "rig.yaml").read_text() == before


def test_a_picture_that_disagrees_is_named(garage: Path, capsys) -> None:
    # The car stood on a ramp.
    camera = read_rig(garage / "rig-a").camera
    ramp = se3.exp(torch.tensor([0.0, 0.0, 0.1, 0.06, 0.0, 0.0], dtype=F64))
    rows = list(csv.DictReader((garage / "pixels.csv").open()))
    room = {f"w{k}": p for k, p in enumerate(WALL)} | {f"f{k}": p for k, p in enumerate(FLOOR)}
    T_camera_room = se3.inverse(camera_pose(*PLACES[1]) @ ramp)
    for row in rows:
        if row["picture"] == "img1":
            p = torch.tensor(room[row["point"]], dtype=F64)
            px = project(camera, se3.transform(T_camera_room, p))[0]
            row["u"], row["v"] = (str(x) for x in px.tolist())
    with (garage / "pixels.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    assert run(garage) == 2
    assert "picture 'img1': its normal is" in capsys.readouterr().err
