"""Offline calibration of the road: `crowdmap calibrate RIG_FOLDER --points points.csv --pixels pixels.csv`.

Surveyed points on a wall and a floor, and where they are in several pictures, give the road's
normal in the camera frame and the camera's height above it; both are written into the folder's
rig.yaml. Columns of the tables: point, x, y, z [m], surface (`wall` or `floor`); and picture,
point, u, v [raw pixels]. CSV with a header, or YAML with the lists `points` and `pixels`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crowdmap_torch.io.calibration import read_annotations, read_surveyed_points, write_rig_road
from crowdmap_torch.io.errors import input_read
from crowdmap_torch.io.rigs import read_camera
from crowdmap_torch.ranges import Degrees, Pixels, argument
from crowdmap_torch.road.calibration import CalibrationConfig, RoadCalibration, calibrate_road


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap calibrate` takes."""
    parser.add_argument("rig", type=Path, metavar="RIG_FOLDER", help="folder with rig.yaml")
    parser.add_argument("--points", type=Path, required=True, help="surveyed points, CSV or YAML")
    parser.add_argument("--pixels", type=Path, required=True, help="their pixels, CSV or YAML")
    defaults = CalibrationConfig()
    parser.add_argument(
        "--max-rms-px",
        type=argument(Pixels),
        default=defaults.max_rms_px,
        help="a picture whose points miss by more is refused",
    )
    parser.add_argument(
        "--max-spread-deg",
        type=argument(Degrees),
        default=defaults.max_spread_deg,
        help="a picture whose normal is further from the mean is refused",
    )
    parser.add_argument("--dry-run", action="store_true", help="show the result, write nothing")


def run(options: argparse.Namespace) -> None:
    """Reads the tables, writes rig.yaml, and shows what was found."""
    with input_read():
        camera = read_camera(options.rig)
        points = read_surveyed_points(options.points)
        seen = read_annotations(options.pixels, points)
        config = CalibrationConfig(
            max_rms_px=options.max_rms_px, max_spread_deg=options.max_spread_deg
        )
        calibration = calibrate_road(camera, points, seen, config)
        if not options.dry_run:
            write_rig_road(options.rig / "rig.yaml", calibration)
    _show(calibration)


def _show(calibration: RoadCalibration) -> None:
    print(f"{'picture':<24} {'error px':>9} {'off mean deg':>13}")
    for row in zip(calibration.picture, calibration.rms_px, calibration.off_deg, strict=True):
        print(f"{row[0]:<24} {row[1]:9.2f} {row[2]:13.3f}")
    normal = ", ".join(f"{x:.6f}" for x in calibration.normal_camera.tolist())
    print(f"normal   [{normal}] +- {calibration.sigma_deg:.3f} deg")
    print(f"height   {calibration.height:.4f} +- {calibration.sigma_height:.4f} m")
