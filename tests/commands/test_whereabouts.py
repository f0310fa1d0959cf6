"""Where `crowdmap optimize` works: what is begun before the data set is read, and ended with it."""

from __future__ import annotations

import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from crowdmap_torch.commands.whereabouts import Whereabouts
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.plausibility.dataset import Look


def options(**changed: object) -> Namespace:
    given = {"device": "cpu", "engine": "processes", "workers": 3, "address": None}
    return Namespace(**{**given, **changed})


def test_no_more_workers_are_begun_early_than_there_are_journeys(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / "journeys" / name).mkdir(parents=True)
    with Whereabouts(options()) as where:
        where.begin_early(tmp_path)
        assert where.at_work is where.engine
        assert where.engine.free == 1
        where.begin(is_needed=True)
        assert where.engine.free == 1


@pytest.mark.parametrize("engine", ["processes", "local"])
def test_of_a_data_set_that_is_not_there_nothing_is_begun(tmp_path: Path, engine: str) -> None:
    with Whereabouts(options(engine=engine)) as where:
        where.begin_early(tmp_path / "missing")
        assert where.engine.free == (3 if engine == "processes" else 1)


def test_signs_told_apart_for_the_look_are_taken_where_mapping_does_it_alike() -> None:
    where, look = Whereabouts(options()), Look((), {})
    assert where.by_whom(look, MapperConfig())["tracklets"] is look.tracklets
    assert where.by_whom(look, MapperConfig(method="paper2017"))["tracklets"] is not look.tracklets


def test_a_worker_imports_nothing_that_draws() -> None:
    program = (
        "import sys, crowdmap_torch.mapper; "
        "print([name for name in ('matplotlib', 'pandas', 'sklearn') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
