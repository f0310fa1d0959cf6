"""Where `crowdmap optimize` works."""

from __future__ import annotations

from argparse import Namespace

from crowdmap_torch.commands.whereabouts import Whereabouts
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.plausibility.dataset import Look


def options(**changed: object) -> Namespace:
    given = {"device": "cpu", "engine": "processes", "workers": 3, "address": None}
    return Namespace(**{**given, **changed})


def test_signs_told_apart_for_the_look_are_taken_where_mapping_does_it_alike() -> None:
    where, look = Whereabouts(options()), Look((), {})
    assert where.by_whom(look, MapperConfig())["tracklets"] is look.tracklets
    assert where.by_whom(look, MapperConfig(method="paper2017"))["tracklets"] is not look.tracklets
