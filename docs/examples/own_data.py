"""Simulated drives in other people's formats: `python docs/examples/own_data.py STREET FILES`.

What a perception stack might leave behind of each drive: `drive.txt` (TUM), `signs.json` (COCO, corners as keypoints),
`lanes.json` (TuSimple) and `images.txt` (time and name of every image); and the rigs' calibrations. docs/OWN_DATA.md makes a
data set of them again.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.datasets import load_journey
from crowdmap_torch.io.poses import read_poses

CLASSES = {
    "triangle": "warning--curve-left--g1",
    "inverted_triangle": "regulatory--yield--g1",
    "rectangle": "regulatory--one-way-right--g3",
    "diamond": "regulatory--priority-road--g4",
    "pentagon": "school-zone",
    "octagon": "regulatory--stop--g1",
}
"""What a detector of Mapillary's classes might call signs of each shape."""
ROWS_PX = 4
"""Rows of the image between two points of a lane marker."""


def main(dataset: Path, out: Path) -> None:
    """Writes `out/JOURNEY/` for each journey, and `out/RIG/`."""
    shutil.copytree(dataset / "rigs", out, dirs_exist_ok=True)
    for journey_folder in sorted((dataset / "journeys").iterdir()):
        write_drive(journey_folder, out / journey_folder.name)


def write_drive(journey_folder: Path, out: Path) -> None:
    """Writes the four files of a journey."""
    out.mkdir(parents=True, exist_ok=True)
    journey, _ = load_journey(journey_folder)
    poses = read_poses(journey_folder / "poses.parquet")
    seconds = [f"{t // 10**9}.{t % 10**9:09d}" for t in poses.t_ns.tolist()]
    names = [f"front/{frame:06d}.jpg" for frame in poses.frame_number.tolist()]

    quaternion = se3.to_quaternion(poses.T_world_link[:, :3, :3])
    numbers = np.concatenate((poses.T_world_link[:, :3, 3].numpy(), quaternion.numpy()), axis=1)
    lines = (
        f"{t} " + " ".join(f"{x:.9f}" for x in row) for t, row in zip(seconds, numbers, strict=True)
    )
    (out / "drive.txt").write_text("\n".join(lines) + "\n")
    (out / "images.txt").write_text(
        "".join(f"{t} {n}\n" for t, n in zip(seconds, names, strict=True))
    )

    size = {"width": journey.rig.camera.width, "height": journey.rig.camera.height}
    content = {
        "images": [{"id": k, "file_name": name, **size} for k, name in enumerate(names)],
        "categories": [{"id": k, "name": CLASSES[s]} for k, s in enumerate(polygon.SHAPES)],
        "annotations": [],
    }
    # In the order of the rows, by which the survey's truth knows them.
    signs = journey.signs[journey.signs.row.argsort()]
    rows = zip(
        signs.frame.tolist(),
        signs.shape.tolist(),
        signs.corners_px.tolist(),
        signs.score.tolist(),
        strict=True,
    )
    for number, (frame, shape, corners, score) in enumerate(rows):
        corners = corners[: int(polygon.CORNER_COUNT[shape])]
        (left, top), (right, bottom) = np.min(corners, 0).tolist(), np.max(corners, 0).tolist()
        content["annotations"].append(
            {
                "id": number,
                "image_id": frame,
                "category_id": shape,
                "bbox": [left + 0.5, top + 0.5, right - left, bottom - top],
                "keypoints": [x for u, v in corners for x in (u, v, 2)],
                "score": score,
            }
        )
    (out / "signs.json").write_text(json.dumps(content))

    v_of_rows = np.arange(0, size["height"], ROWS_PX)
    lanes: list[list[list[float]]] = [[] for _ in names]
    for number in journey.lanes.row.argsort().tolist():
        frame = int(journey.lanes.frame[number])
        u, v = journey.lane_points.px[journey.lane_points.detection == number].numpy().T
        order = np.argsort(v)
        inside = (v_of_rows >= v.min()) & (v_of_rows <= v.max())
        column = np.where(inside, np.interp(v_of_rows, v[order], u[order]), -2)
        lanes[frame].append(column.round(2).tolist())
    objects = (
        {"raw_file": name, "lanes": markers, "h_samples": v_of_rows.tolist()}
        for name, markers in zip(names, lanes, strict=True)
    )
    (out / "lanes.json").write_text("".join(f"{json.dumps(one)}\n" for one in objects))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
