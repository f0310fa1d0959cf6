"""Everything follows the data's device: the whole mapper on a pretended one, to the same bits."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor
from worlds.devices import FRAMES, differences, first_frames, optimized, short
from worlds.drives import write_tiny
from worlds.pretend_device import DEVICE, PretendTensor, Transfers, pretend_device

from crowdmap_torch import mapper
from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.signs_alone import moved_by_signs
from crowdmap_torch.commands.whereabouts import Whereabouts
from crowdmap_torch.crowd_signs.completion import AssociatedSigns
from crowdmap_torch.evaluation.evaluate import against, evaluate_map, progress_scalars
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import read_truth
from crowdmap_torch.optim import band_cholesky
from crowdmap_torch.optim.linearize import term_costs
from crowdmap_torch.optim.solvers import sparse_tiles, windows
from crowdmap_torch.processes import sums
from crowdmap_torch.processes.threads import repeatable
from crowdmap_torch.single_journey import SingleJourneyMapper, frame_of
from crowdmap_torch.tables import Dataset, Journey, Lanes, Rows, Signs, to_device

# What torch does in no fixed order there it warns of.
pytestmark = pytest.mark.filterwarnings("error:.*deterministic")


@pytest.fixture(scope="module")
def transfers(
    first_here: Stages,
    placed_here: tuple[Tensor, ...],
    frames_here: FrameByFrame,
    run_here: tuple[Path, str],
) -> Iterator[Transfers]:
    """The device is there for all tests of this file, but not for what is made before it: every operation costs more."""
    before = torch.are_deterministic_algorithms_enabled()
    with pretend_device() as counted:
        repeatable(DEVICE)
        yield counted
    torch.use_deterministic_algorithms(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short journeys: every operation is looked at, which takes its time."""
    out = tmp_path_factory.mktemp("device") / "dataset"
    return write_tiny(out, journeys=2, frame_rate_hz=4.0, length_m=70.0)


@pytest.fixture(scope="module")
def here(folder: Path) -> Dataset:
    return load_dataset(folder)


@pytest.fixture(scope="module", autouse=True)
def one_way_to_compute() -> Iterator[None]:
    """What the CPU does and no other device rounds otherwise in the last bits: LAPACK's bands, products in place."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(band_cholesky, "_by_lapack", band_cholesky._by_blocks)
        patch.setattr(windows, "_in_place", lambda device: False)
        patch.setattr(sums, "_sorts", lambda device: True)
        patch.setattr(sums, "_MANY", 1)
        # Small ones, so that there are many.
        for name, width in (("_ONE_TILE", 100), ("_WIDTH", 64), ("_WIDTH_CUDA", 64)):
            patch.setattr(sparse_tiles, name, width)
        yield


@pytest.fixture(scope="module")
def there(here: Dataset, transfers: Transfers) -> Dataset:
    return to_device(here, DEVICE)


Stages = tuple[tuple[mapper.JourneyMap, ...], mapper.FirstMap]
FrameByFrame = tuple[Tensor, Signs | None, Lanes | None]


@pytest.fixture(scope="module")
def first_here(here: Dataset) -> Stages:
    maps = mapper.map_journeys(here.journeys, short())
    return maps, mapper.first_map(here.journeys, maps, short())


@pytest.fixture(scope="module")
def frames_here(here: Dataset) -> FrameByFrame:
    return frame_by_frame(first_frames(here))


@pytest.fixture(scope="module")
def run_here(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run of the main job on the CPU, and what it said."""
    return optimized(folder, tmp_path_factory.mktemp("here") / "run", "cpu")


def placed_by_signs(
    dataset: Dataset, maps: Sequence[mapper.JourneyMap], heads: mapper.FirstMap
) -> tuple[Tensor, ...]:
    """Where an adjustment of signs alone takes drives."""
    config, shown = short(), (heads.signs, heads.tentative, heads.associations, heads.completed)
    given = dataset.journeys, [m.road for m in maps], [m.lanes for m in maps], heads.crowd
    assert heads.ties is not None
    found = AssociatedSigns(*shown), heads.drifts, heads.ties.group
    return moved_by_signs(*given, *found, config.adjust, config.calibration)


@pytest.fixture(scope="module")
def placed_here(here: Dataset, first_here: Stages) -> tuple[Tensor, ...]:
    return placed_by_signs(here, *first_here)


@pytest.fixture(scope="module")
def first(first_here: Stages, transfers: Transfers) -> Stages:
    """The same stages, moved there."""
    return to_device(first_here, DEVICE)


def test_tensors_of_two_devices_do_not_meet(transfers: Transfers):
    here, away = torch.ones(3), torch.ones(3, device=DEVICE)
    assert isinstance(away, PretendTensor) and away.is_cuda and away.device == DEVICE
    with pytest.raises(RuntimeError, match="on one device"):
        away.add(here)
    with pytest.raises(RuntimeError, match="on one device"):
        here[away.long()]
    with pytest.raises(TypeError, match=r"\.cpu\(\)"):
        away.numpy()
    transfers.clear()
    assert float((away + here.sum()).sum()) == 12.0
    assert (transfers.scalars, sum(transfers.back.values())) == (1, 0)
    assert away.tolist() == [1.0, 1.0, 1.0]
    assert transfers.back == {(3,): 1}


def test_tables_move_down_to_the_last_tensor(there: Dataset):
    def tensors(value: object) -> Iterator[Tensor]:
        if isinstance(value, Tensor):
            yield value
        elif is_dataclass(value):
            for f in fields(value):
                yield from tensors(getattr(value, f.name))

    for journey in there.journeys:
        assert all(isinstance(x, PretendTensor) for x in tensors(journey))
    assert to_device(there, DEVICE).journeys[0] is there.journeys[0]


def test_a_step_brings_a_few_numbers_back(there: Dataset, first, transfers):
    maps, heads = first
    bundle = mapper.build_bundle(there.journeys, maps, heads, short())
    begun = adjust.start(bundle)
    terms = len(bundle.problem().terms)
    transfers.clear()
    for _ in adjust.steps(bundle, begun):
        # A number of each term at most, and the few different widths of windows, come as lists of numbers.
        assert all(len(shape) == 1 and shape[0] <= terms for shape in transfers.back), (
            transfers.back
        )
        assert sum(transfers.back.values()) <= 12
        assert transfers.scalars <= 60
        transfers.clear()


def test_a_bundle_moves_with_all_that_it_holds(here: Dataset, first_here, transfers: Transfers):
    maps, heads = first_here
    bundle = mapper.build_bundle(here.journeys, maps, heads, short())
    costs = term_costs(bundle.problem(), bundle.values())
    moved = bundle.to(DEVICE)
    with torch.no_grad():
        again = term_costs(moved.problem(), moved.values())
    for name, cost in again.items():
        assert isinstance(cost, PretendTensor), name
        assert torch.equal(cost.cpu(), costs[name]), name


def test_maps_on_a_device_are_judged_beside_a_survey_on_the_cpu(
    folder: Path, here: Dataset, there: Dataset, first
):
    heads = first[1]
    survey = read_survey(folder / "survey")
    truth = read_truth(folder / "survey", survey, here.journeys)
    clusters = mapper.clusters_map(there, heads)
    figures = evaluate_map(clusters, survey, truth=truth)
    same = evaluate_map(to_device(clusters, "cpu"), survey, truth=truth)
    assert figures.signs.absolute == same.signs.absolute
    scalars = progress_scalars(heads.signs, against(survey), lanes=heads.lanes)
    signs, lanes = to_device((heads.signs, heads.lanes), "cpu")
    assert scalars == progress_scalars(signs, against(survey), lanes=lanes)


def test_signs_alone_place_drives_as_they_do_on_the_cpu(placed_here, there: Dataset, first):
    found = placed_by_signs(there, *first)
    for one, other in zip(found, placed_here, strict=True):
        assert isinstance(one, PretendTensor)
        assert torch.equal(one.cpu(), other)


class AtOnce:
    """An executor without a thread: what torch is told to look at, it looks at in one thread alone."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def submit(self, work: Callable[..., object], *args: object) -> Future:
        done: Future = Future()
        done.set_result(work(*args))
        return done


def frame_by_frame(journey: Journey) -> FrameByFrame:
    """The tracklet of each sign detection as its frame came, and what the drive shows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("crowdmap_torch.single_journey.ThreadPoolExecutor", AtOnce)
        one = SingleJourneyMapper(journey.rig)
        labels = [one.step(frame_of(journey, i)).sign_tracklet.cpu() for i in range(FRAMES)]
        return torch.cat(labels), *one.finish()


def test_a_drive_is_mapped_frame_by_frame(here: Dataset, frames_here: FrameByFrame, transfers):
    labels, *made = frames_here
    labels_there, *made_there = frame_by_frame(to_device(first_frames(here), DEVICE))
    assert torch.equal(labels, labels_there)
    for table, other in zip(made, made_there, strict=True):
        assert isinstance(table, Rows) and isinstance(other, Rows)
        assert list(differences(table, other)) == []


def test_optimize_makes_the_cpus_map_to_the_last_bit(
    folder: Path, tmp_path: Path, run_here: tuple[Path, str], transfers
):
    maps = []
    for run, said in (run_here, optimized(folder, tmp_path / "run", "cuda:0")):
        assert (run / "report.html").exists()
        assert "relative corner" in said
        maps.append(read_map(run / "map"))
    here, there = maps
    assert len(here.signs) and len(here.lanes)
    assert list(differences(here.signs, there.signs)) == []
    assert list(differences(here.lanes, there.lanes)) == []
    assert torch.equal(here.shared_covariance, there.shared_covariance)


def test_journeys_are_mapped_by_processes_on_the_cpu_where_there_are_several(
    here: Dataset, first_here: Stages, transfers
):
    asked = {"device": "cuda:0", "address": None}
    alone = Whereabouts(Namespace(engine=None, workers=1, **asked))
    assert (alone.engine.name, alone.of_journeys) == ("local", DEVICE)
    beside = Whereabouts(Namespace(engine=None, workers=2, **asked))
    assert (beside.engine.name, beside.of_journeys.type) == ("processes", "cpu")
    # What they made is moved once.
    transfers.clear()
    dataset, maps = beside.mapped(here, first_here[0])
    assert isinstance(dataset.journeys[0].t_ns, PretendTensor)
    assert isinstance(maps[0].signs.size, PretendTensor)
    assert not transfers.back and not transfers.scalars
