"""The main job on a small simulated street: what it writes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from worlds.runs import Said, journeys_of, spoil_pose

from crowdmap_torch import mapper
from crowdmap_torch.cli import main
from crowdmap_torch.commands import optimize as optimize_command
from crowdmap_torch.config import MapperConfig, load_config
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.rigs import read_rig
from crowdmap_torch.tables import Dataset

LANDMARK = {"n_journeys", "n_observations", "first_seen_ns", "last_seen_ns", "confidence"}
SIGN = LANDMARK | {
    *("sign_id", "shape", "type", "corners", "center", "normal", "width_m", "height_m"),
    "covariance",
}
LANE = LANDMARK | {"lane_id", "type", "control_points", "points", "sigma_m"}


@pytest.fixture(scope="module")
def run(tiny_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with the default configuration."""
    out = tmp_path_factory.mktemp("run") / "run"
    assert main(["optimize", str(tiny_folder), "--out", str(out), "--workers", "1"]) == 0
    return out


@pytest.fixture
def quick(
    monkeypatch: pytest.MonkeyPatch, tiny_result: mapper.MapResult, tmp_path: Path
) -> tuple[str, ...]:
    """Options of a run of three steps, with each journey's own map from memory and no report: what is between is tested."""
    maps = tiny_result.journey_maps
    monkeypatch.setattr(mapper, "map_journeys", lambda journeys, *a, **k: maps[: len(journeys)])
    monkeypatch.setattr(optimize_command, "write_report", lambda path, record: path.touch())
    (tmp_path / "quick.yaml").write_text("adjust: {lm: {max_iterations: 3}}\n")
    return ("--config", str(tmp_path / "quick.yaml"))


def swap_axes(journey: Path) -> None:
    """Quaternions as w x y z."""
    path = journey / "poses.parquet"
    table = pq.read_table(path)
    x, y, z, w = (table[name] for name in ("qx", "qy", "qz", "qw"))
    for name, column in zip(("qx", "qy", "qz", "qw"), (w, x, y, z), strict=True):
        table = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, path)


def columns(path: Path) -> set[str]:
    return set(pq.read_schema(path).names)


# What a run writes.


def test_the_board_tells_which_share_of_sign_corners_was_given_up(run: Path):
    board = EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0}).Reload()
    share = [event.value for event in board.Scalars("robust/given_up")]
    # None before detections are judged; of the simulation's outliers, 1 %, some are afterwards.
    assert share[0] == 0 and 0 < share[-1] < 0.05


def test_every_output_is_there_and_nothing_half_written(run: Path, tiny: Dataset):
    names = {path.name for path in run.iterdir()}
    assert names >= {
        *("map", "map_clusters", "journeys", "associations.parquet", "metrics.json"),
        *("report.html", "tensorboard", "config.yaml"),
    }
    assert not [name for name in names if name.startswith(".")]
    assert {p.name for p in (run / "journeys").iterdir()} == {j.journey_id for j in tiny.journeys}
    assert list((run / "tensorboard").glob("events.out.tfevents.*"))


@pytest.mark.parametrize("name", ["map", "map_clusters"])
def test_maps_have_the_columns_of_the_format(run: Path, tiny: Dataset, name: str):
    folder = run / name
    assert columns(folder / "signs.parquet") >= SIGN
    assert columns(folder / "tentative_signs.parquet") >= SIGN
    assert columns(folder / "lanes.parquet") >= LANE
    head = json.loads((folder / "map.json").read_text())
    assert head["format"] == "crowdmap-map" and head["version"] == 1
    assert len(head["shared_covariance"]) == 9
    assert {"version", "config", "journeys", "created_at"} <= set(head["provenance"])
    hd_map = read_map(folder)
    assert len(hd_map.signs) and len(hd_map.lanes) and hd_map.origin == tiny.origin
    assert (hd_map.signs.confidence >= 0.5).all()


def test_the_adjusted_map_knows_how_well_it_knows(run: Path):
    hd_map = read_map(run / "map")
    covariance = hd_map.signs.covariance
    assert torch.allclose(covariance, covariance.mT)
    assert (torch.linalg.eigvalsh(covariance) > 0).all()
    assert (torch.linalg.eigvalsh(hd_map.shared_covariance) > 0).all()
    assert (hd_map.lanes.control.sigma > 0).all()


def test_each_journey_has_its_refined_poses_landmarks_and_road(
    run: Path, tiny_folder: Path, tiny: Dataset
):
    for journey in tiny.journeys:
        folder = run / "journeys" / journey.journey_id
        given = pq.read_table(tiny_folder / "journeys" / journey.journey_id / "poses.parquet")
        refined = pq.read_table(folder / "poses.parquet")
        assert refined.column_names == given.column_names
        for same in ("frame", "t_ns"):
            assert refined[same].equals(given[same])
        moved = np.stack([refined[k].to_numpy() - given[k].to_numpy() for k in "xyz"])
        assert 0 < np.abs(moved).max() < 3
        assert columns(folder / "signs.parquet") >= SIGN
        assert columns(folder / "lanes.parquet") >= LANE
        road = pq.read_table(folder / "road.parquet")
        assert road.column_names == ["frame", "nx", "ny", "nz", "height_m", "sigma"]
        assert road["frame"].equals(given["frame"])
        normal = np.stack([road[f"n{k}"].to_numpy() for k in "xyz"])
        assert np.allclose(np.linalg.norm(normal, axis=0), 1)


def test_associations_name_a_landmark_or_none_for_every_row(run: Path, tiny_folder: Path):
    table = pq.read_table(run / "associations.parquet")
    assert table.column_names == ["journey_id", "kind", "row", "landmark_id"]
    rows = sorted(zip(*(table[k].to_pylist() for k in ("journey_id", "kind", "row")), strict=True))
    expected = [
        (journey.name, kind, row)
        for journey in journeys_of(tiny_folder)
        for kind in ("sign", "lane")
        for row in range(pq.read_metadata(journey / f"{kind}s.parquet").num_rows)
    ]
    assert rows == sorted(expected)
    hd_map = read_map(run / "map")
    named = {name for name in table["landmark_id"].to_pylist() if name is not None}
    assert named <= set(hd_map.sign_id) | set(hd_map.lane_id)
    # Each of them was made from detections.
    assert named >= set(hd_map.sign_id)


def test_metrics_tell_counts_times_costs_and_figures(run: Path):
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["rejected_journeys"] == metrics["suspect_journeys"] == []
    assert metrics["counts"]["journeys"] == 3
    assert metrics["counts"]["signs of the map"] == len(read_map(run / "map").signs)
    assert all(seconds >= 0 for seconds in metrics["times_s"].values())
    assert metrics["outcome"].startswith("converged")
    assert {"iteration", "total", "sign_reprojection"} <= set(metrics["costs"][0])
    assert metrics["survey"]["signs"]["recall"] > 0.8
    assert metrics["survey_clusters"] is not None


def test_metrics_tell_how_sure_corners_and_biases_are(run: Path):
    metrics = json.loads((run / "metrics.json").read_text())
    signs = {
        row["sign_id"]: row for row in pq.read_table(run / "map" / "signs.parquet").to_pylist()
    }
    corners = {row["sign_id"]: row["covariance"] for row in metrics["sign_corners"]}
    assert set(signs) <= set(corners)
    for name, sign in signs.items():
        assert len(corners[name]) == len(sign["corners"])
        of_corner = torch.tensor(corners[name]).view(-1, 3, 3)
        of_center = torch.tensor(sign["covariance"]).view(3, 3)
        # A corner is never known better than by what the centre's bias leaves: here decimetres.
        assert (of_corner.diagonal(dim1=1, dim2=2).sum(1) > 0.9 * of_center.trace()).all()
    for journey in metrics["journeys"]:
        covariance = torch.tensor(journey["bias_covariance"]).view(3, 3)
        assert (torch.linalg.eigvalsh(covariance) > 0).all()
        # The module's own sigma is 0.4 m, and three journeys share what nobody can tell.
        assert (covariance.diagonal().sqrt() > 0.1).all() and covariance.trace() < 1.0
        assert 0 < journey["heading_sigma_deg"] < 0.2
        assert abs(journey["heading_deg"]) < 5 * journey["heading_sigma_deg"]
        scales = dict(journey["sigma_scale"])
        assert set(scales.pop("at_bound")) <= set(scales)
        noise = {f"{kind}{of}" for kind in ("noise", "rotation_noise") for of in ("", "_by_axis")}
        assert set(scales) == {"bias", "drift", "rotation", *noise}


def test_the_report_needs_nothing_else(run: Path):
    html = (run / "report.html").read_text(encoding="utf-8")
    assert "<svg" in html and "<script src" not in html and 'href="http' not in html


def test_the_configuration_is_written_with_defaults_filled_in(run: Path):
    assert load_config(run / "config.yaml") == MapperConfig()
    assert "adjust" in yaml.safe_load((run / "config.yaml").read_text())


# Datasets with little in them.


def test_bad_journeys_are_set_aside_and_the_one_that_is_left_is_the_map(
    optimize, copy: Path, tmp_path: Path
):
    first, second, third = journeys_of(copy)
    spoil_pose(second)
    (third / "lanes.parquet").unlink()
    out = tmp_path / "run"
    said = optimize(copy, out)
    assert said.code == 0
    aside = [line for line in said.err.splitlines() if line.startswith("set aside ")]
    assert len(aside) == 2 and second.name in aside[0] and third.name in aside[1]
    rejected = json.loads((out / "metrics.json").read_text())["rejected_journeys"]
    assert [r["journey_id"] for r in rejected] == [second.name, third.name]
    assert "'x'" in rejected[0]["reason"] and "lanes.parquet" in rejected[1]["reason"]
    assert [p.name for p in journeys_of(out)] == [first.name]
    # Of a single journey, its own signs are the map.
    hd_map = read_map(out / "map")
    assert len(hd_map.signs) >= 3 and len(hd_map.lanes) >= 1
    assert (hd_map.signs.n_journeys == 1).all()
    assert (out / "report.html").exists()


def test_journeys_without_detections_give_a_map_without_rows(optimize, copy: Path, tmp_path: Path):
    shutil.rmtree(copy / "survey" / "truth")  # it is about the detections
    for journey in journeys_of(copy):
        for name in ("signs", "lanes"):
            path = journey / f"{name}.parquet"
            pq.write_table(pq.read_table(path).slice(0, 0), path)
    out = tmp_path / "run"
    said = optimize(copy, out, "--strict")
    assert said.code == 3 and "looks wrong: the map is empty: not one sign or lane" in said.err
    (warning,) = json.loads((out / "metrics.json").read_text())["warnings"]
    assert warning["kind"] == "no-detections"
    assert "not one sign or lane marker was detected" in (out / "report.html").read_text()
    for name in ("map", "map_clusters"):
        assert columns(out / name / "signs.parquet") >= SIGN
        assert columns(out / name / "lanes.parquet") >= LANE
        hd_map = read_map(out / name)
        assert len(hd_map.signs) == len(hd_map.lanes) == 0
    assert pq.read_table(out / "associations.parquet").num_rows == 0
    assert json.loads((out / "metrics.json").read_text())["counts"]["signs of the map"] == 0
    assert (out / "report.html").exists()
    given, refined = (
        pq.read_table(d / "journeys" / "journey-000" / "poses.parquet") for d in (copy, out)
    )
    assert np.allclose(given["x"].to_numpy(), refined["x"].to_numpy())


def test_control_points_pin_the_map_and_are_left_out_of_its_figures(
    optimize, quick, copy: Path, tmp_path: Path
):
    said = optimize(copy, tmp_path / "run", *quick, "--control", str(copy / "survey"))
    assert said.code == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["counts"]["control points"] > 0
    assert metrics["survey"]["control_signs"] >= metrics["counts"]["control points"]
    assert metrics["survey"]["signs"]["matched_observable"] == 0


def test_a_run_says_what_its_cars_have_wrong(run: Path, tiny: Dataset):
    found = json.loads((run / "calibration.json").read_text())
    assert found["format"] == "crowdmap-calibration" and found["version"] == 1
    assert found["cars"].keys() == {journey.vehicle for journey in tiny.journeys}
    for name, car in found["cars"].items():
        assert car["journeys"] == sum(journey.vehicle == name for journey in tiny.journeys)
        for one in car["parameters"].values():
            # Nothing is less sure than before.
            assert all(
                0 < s <= 1.001 * p for s, p in zip(one["sigma"], one["prior_sigma"], strict=True)
            )
        rig = read_rig(run / "rigs" / name)
        stated = next(j.rig for j in tiny.journeys if j.vehicle == name)
        share = 1 + car["parameters"]["focal"]["estimate"][0]
        torch.testing.assert_close(rig.camera.K[0, 0], stated.camera.K[0, 0] * share)
    report = (run / "report.html").read_text()
    assert 'id="calibration"' in report and "truth minus rig.yaml" in report
    board = EventAccumulator(str(run / "tensorboard"))
    board.Reload()
    assert any(tag.startswith("calibration/mount_deg_0/") for tag in board.Tags()["scalars"])


def test_what_a_run_found_of_cars_is_begun_with_and_others_are_named(
    optimize, run: Path, tiny_folder: Path, tmp_path: Path, quick: tuple[str, ...]
):
    content = json.loads((run / "calibration.json").read_text())
    before = content["cars"]
    new, _ = before.popitem()
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    said = optimize(tiny_folder, tmp_path / "again", *quick, "--calibration", str(tmp_path))
    assert said.code == 0 and before
    assert said.err.startswith(f"warning: --calibration {tmp_path}: nothing is known of {new}\n")
    after = json.loads((tmp_path / "again" / "calibration.json").read_text())["cars"]
    for name, car in before.items():
        for key, one in car["parameters"].items():
            found = after[name]["parameters"][key]
            assert found["prior_sigma"] == pytest.approx(one["sigma"], rel=1e-9)


def test_calibration_off_leaves_rigs_as_they_are(
    optimize, tiny_folder: Path, tmp_path: Path, quick: tuple[str, ...]
):
    assert optimize(tiny_folder, tmp_path / "run", *quick, "--calibration", "off").code == 0
    assert not (tmp_path / "run" / "calibration.json").exists()
    assert not (tmp_path / "run" / "rigs").exists()


def test_what_each_drive_does_to_the_map_is_told(
    optimize, tiny_folder: Path, tmp_path: Path, quick: tuple[str, ...]
):
    run = tmp_path / "run"
    assert optimize(tiny_folder, run, *quick, "--influence").code == 0
    journeys = json.loads((run / "metrics.json").read_text())["journeys"]
    known = read_map(run / "map").sign_id
    for found in (journey["without_it"] for journey in journeys):
        assert 0.05 < found["in_sigmas"] < 2 and 0 < found["farthest_m"] < 2
        assert found["farthest_sign"] in known and found["across_m"] > 0


@pytest.mark.parametrize(
    ("name", "estimate", "message"),
    [
        ("height_m", [-5.0], "rig put right.road.height_m: expected a number in 0.01"),
        ("mount_deg", [0.1, 0.1], "mount_deg: expected 3 numbers, found 2"),
    ],
)
def test_a_calibration_that_makes_no_rig_is_one_line(
    optimize,
    run: Path,
    tiny_folder: Path,
    tmp_path: Path,
    name: str,
    estimate: list[float],
    message,
):
    content = json.loads((run / "calibration.json").read_text())
    for car in content["cars"].values():
        car["parameters"][name] |= {"estimate": estimate, "sigma": [0.1] * len(estimate)}
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    said = optimize(tiny_folder, tmp_path / "run", "--calibration", str(tmp_path))
    assert said.code == 2 and said.err.count("\n") == 1
    assert message in said.err and not (tmp_path / "run").exists()


def test_what_looks_wrong_is_said_before_mapping_and_kept(
    copy: Path, tmp_path: Path, optimize: Callable[..., Said], quick: tuple[str, ...]
):
    for journey in journeys_of(copy):
        swap_axes(journey)
    said = optimize(copy, tmp_path / "run", *quick)
    lines = [line for line in said.err.splitlines() if line.startswith("looks wrong: ")]
    assert "quaternions are stored as w x y z; store qx qy qz qw" in lines[0]
    # What becomes of such a map is another matter: it may have no sign, which is said after it.
    warning, *after = json.loads((tmp_path / "run" / "metrics.json").read_text())["warnings"]
    assert warning["kind"] == "quaternion-order" and len(lines) == 1 + len(after)
    assert all(one["kind"].startswith("no-") for one in after)
    assert warning["journeys"] == [path.name for path in journeys_of(copy)]


def test_nothing_looks_wrong_with_a_good_data_set(run: Path):
    assert json.loads((run / "metrics.json").read_text())["warnings"] == []
