"""What is watched before the adjustment: figures of the stages' own reports, each once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.util.tensor_util import make_ndarray

from crowdmap_torch import mapper
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_signs.outages import Outage
from crowdmap_torch.crowd_signs.outlier_journeys import OutlierJourney
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.stages import keep_and_log, log_crowd, log_journey
from crowdmap_torch.report.tensorboard import TensorBoardLog
from crowdmap_torch.tables import Dataset, RejectedJourney


def read(folder: Path) -> EventAccumulator:
    size = {"scalars": 0, "histograms": 0, "images": 0, "tensors": 0}
    return EventAccumulator(str(folder), size_guidance=size).Reload()


@pytest.fixture(scope="module")
def events(tiny: Dataset, tiny_result: MapResult, tmp_path_factory) -> EventAccumulator:
    """All journeys of a run and its crowd; one journey was set aside at the door, another does not fit the others."""
    folder: Path = tmp_path_factory.mktemp("log")
    first, report = tiny_result.first, tiny_result.first.crowd.report
    misfit = OutlierJourney(1, "its bias of 9.8 m does not fit the others")
    report = replace(report, outlier_journeys=(misfit,), outages=(Outage(2, 120.0, 310.4, 2.75),))
    crowd = replace(first.crowd, report=report)
    rejected = RejectedJourney("broken", "poses.parquet: row 3: x is NaN")
    with TensorBoardLog(folder) as log:
        for number, made in enumerate(tiny_result.journey_maps):
            log_journey(log, tiny.journeys[number], number, made)
        log_crowd(log, replace(tiny, rejected=(rejected,)), replace(first, crowd=crowd))
    return read(folder)


def by_step(events: EventAccumulator, tag: str) -> list[float]:
    """The values of a tag; its steps are 0, 1, ..."""
    found = events.Scalars(tag)
    assert [e.step for e in found] == list(range(len(found)))
    return [e.value for e in found]


def test_each_journey_shows_what_its_reports_say(events, tiny, tiny_result):
    maps = tiny_result.journey_maps
    assert by_step(events, "association/sign_tracklets") == [m.sign_tracklets.count for m in maps]
    assert by_step(events, "triangulation/kept") == [m.sign_report.pruned["kept"] for m in maps]
    pruned = [m.sign_report.pruned["too few frames"] for m in maps]
    assert by_step(events, "triangulation/too_few_frames") == pruned
    assert by_step(events, "lanes/kept") == [m.lane_report.pruned["kept"] for m in maps]
    for made, event in zip(
        maps, events.Histograms("association/detections_of_a_sign_tracklet"), strict=True
    ):
        lengths = event.histogram_value
        assert lengths.num == made.sign_tracklets.count
        assert lengths.sum == int((made.sign_tracklets.label >= 0).sum())
    heights = [float(m.road.height.mean()) for m in maps]
    assert by_step(events, "road/height_m") == pytest.approx(heights, rel=1e-6)
    angles = by_step(events, "road/angle_to_calibration_deg")
    # The road is a few degrees off what was calibrated: the car pitches.
    assert all(0 < angle < 5 for angle in angles)


def test_clusters_show_their_rounds_and_spectra(events, tiny_result):
    report = tiny_result.first.crowd.report
    assert by_step(events, "clusters/sign_clusters") == [r.clusters for r in report.rounds]
    assert by_step(events, "clusters/single_signs") == [r.singles for r in report.rounds]
    spectra = events.Histograms("clusters/eigenvalues")
    assert [e.histogram_value.num for e in spectra] == [len(s.eigenvalues) for s in report.spectra]
    size = events.Histograms("clusters/signs_of_a_cluster")[0].histogram_value
    assert size.num == len(tiny_result.first.crowd.heads) and size.min >= 2
    assert events.Tags()["images"] == ["clusters/eigengaps"]


def test_biases_are_what_is_added_to_the_given_positions(events, tiny, tiny_result):
    adjusted = tiny_result.uncertainty.bias
    for k, axis in enumerate(("east", "north", "up")):
        first = torch.tensor(by_step(events, f"bias/{axis}_m"), dtype=torch.float64)
        # The adjustment moves the journeys of a small street by less than a metre more.
        assert (first - adjusted[:, k].cpu()).abs().max() < 1
    first = torch.stack([drift[:, :3].mean(0) for drift in tiny_result.first.drifts])
    assert by_step(events, "bias/up_m") == pytest.approx(first[:, 2].tolist(), rel=1e-5)


def test_bad_drives_are_named_with_their_reason(events, tiny):
    (event,) = events.Tensors("bad_drives/text_summary")
    text = bytes(make_ndarray(event.tensor_proto)[0]).decode()
    assert text.splitlines() == [
        "    broken: poses.parquet: row 3: x is NaN",
        f"    {tiny.journeys[1].journey_id}: its bias of 9.8 m does not fit the others",
        f"    {tiny.journeys[2].journey_id}: its positions are off by 2.8 m from 120 to 310 m of its way",
    ]


def test_a_run_that_goes_on_logs_only_the_journeys_that_it_makes(tiny, tiny_result, tmp_path: Path):
    known = dict(enumerate(tiny_result.journey_maps))
    missing = known.pop(1)
    kept: list[int] = []
    with TensorBoardLog(tmp_path) as log:
        keep = keep_and_log(lambda number, _: kept.append(number), log, tiny.journeys)
        mapper.map_journeys(tiny.journeys, MapperConfig(), known=known, keep=keep)
    assert kept == [1]
    logged = read(tmp_path).Scalars("association/sign_tracklets")
    assert [(e.step, e.value) for e in logged] == [(1, missing.sign_tracklets.count)]
