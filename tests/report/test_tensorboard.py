from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from crowdmap_torch.report.tensorboard import TensorBoardLog


def read(folder: Path) -> EventAccumulator:
    return EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0}).Reload()


def test_iterations_are_scalars_by_path(record, tmp_path: Path):
    with TensorBoardLog(tmp_path) as log:
        for iteration in record.iterations:
            log.log_iteration(iteration, down_weighted={"sign_reprojection": 0.02})
    events = read(tmp_path)
    tags = set(events.Tags()["scalars"])
    assert {
        "cost/sign_reprojection",
        "cost/pose_absolute",
        "cost/total",
        "solver/damping",
        "solver/step_norm",
        "solver/gain_ratio",
        "robust/down_weighted_sign_reprojection",
        "error/corner_m",
    } <= tags
    total = events.Scalars("cost/total")
    assert [e.step for e in total] == [0, 1, 2, 3, 4]
    assert total[0].value == pytest.approx(103)


def test_histograms_survive_empty_and_unknown_values(tmp_path: Path):
    with TensorBoardLog(tmp_path) as log:
        log.log_histogram("residual/empty", torch.zeros(0), 0)
        log.log_histogram("residual/unknown", torch.full((4,), torch.nan), 0)
        log.log_histogram("residual/known", torch.tensor([1.0, torch.nan, 2.0, torch.inf]), 0)
        log.log_histogram("residual/many", torch.arange(600_001, dtype=torch.float64), 0)
        log.log_scalars({"error/none": float("nan"), "error/some": 1.0}, 0)
    events = read(tmp_path)
    assert set(events.Tags()["histograms"]) == {"residual/known", "residual/many"}
    assert events.Histograms("residual/known")[0].histogram_value.num == 2
    assert events.Tags()["scalars"] == ["error/some"]


def test_the_config_and_the_maps_are_there(record, tmp_path: Path):
    with TensorBoardLog(tmp_path) as log:
        log.log_config(record.config_yaml)
        log.log_map("map/before", record.map_before, record.survey, 0)
        log.log_map("map/after", record.hd_map, record.survey, 5)
    events = read(tmp_path)
    assert events.Tags()["images"] == ["map/before", "map/after"]
    assert events.Tags()["tensors"] == ["config/text_summary"]


def test_what_a_run_logged_before_it_was_cut_is_not_logged_again(tmp_path: Path):
    for cut in (True, False):
        with TensorBoardLog(tmp_path) as log:
            log.log_config("a: 1")
            log.log_scalars({"cost/total": 2.0}, 1)
            log.log_histogram("residual/sign", torch.arange(4.0), 1)
            log.log_scalars({"cost/total": 1.0}, 2)
        if cut:
            # In the midst of its last record.
            (path,) = tmp_path.iterdir()
            path.write_bytes(path.read_bytes()[:-9])
    events = read(tmp_path)
    assert [event.step for event in events.Scalars("cost/total")] == [1, 2]
    assert len(events.Histograms("residual/sign")) == 1
    assert len(events.Tensors("config/text_summary")) == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_a_full_disk_is_an_error_where_it_happens(tmp_path: Path, monkeypatch):
    with pytest.raises(OSError, match=r"No space left on device: '.*tfevents"):
        opened = Path.open
        monkeypatch.setattr(Path, "open", lambda path, mode: opened(Path("/dev/full"), mode))
        TensorBoardLog(tmp_path)
