"""Worlds at random: the same by number, all of them options that the simulator takes, and told by what their maps lack."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from crowdmap_torch.commands import simulate
from crowdmap_torch.soak import worlds
from crowdmap_torch.soak.wide_worlds import drawn_wide_world

DRAWN = (worlds.drawn_world, drawn_wide_world)

FOUND = {
    "signs": {
        "observable": 8,
        "recall": 1.0,
        "precision": 1.0,
        "relative": {"total": {"mean": 0.05}},
    },
    "uncertainty": {"coverage": 0.875},
}


def missing(recall: float, precision: float | None) -> dict:
    signs = {**FOUND["signs"], "recall": recall, "precision": precision}
    return {**FOUND, "signs": signs}


def written(figures: dict | None):
    """A command line that maps nothing, but writes these figures; None: it fails."""

    def main(arguments: list[str]) -> int:
        if arguments[0] == "optimize":
            if figures is None:
                return 1
            run = Path(arguments[3])
            run.mkdir(parents=True)
            (run / "metrics.json").write_text(json.dumps({"survey": figures}))
        return 0

    return main


def told(number: int, *, wide: bool = False) -> int:
    return worlds.run(argparse.Namespace(first=number, count=1, wide=wide))


@pytest.mark.parametrize("drawn", DRAWN)
def test_a_world_is_the_same_by_its_number(drawn: Callable[[int], list[str]]):
    assert drawn(7) == drawn(7) != drawn(8)


@pytest.mark.parametrize("drawn", DRAWN)
def test_the_simulator_takes_every_world(drawn: Callable[[int], list[str]]):
    # A parser's options take 40 ms to make, and are the same for all.
    parser = argparse.ArgumentParser()
    simulate.add_arguments(parser)
    for number in range(200):
        given = parser.parse_args(["data", *drawn(number)])
        assert given.seed == number


def test_wide_worlds_have_what_others_lack():
    every = [word for number in range(100) for word in drawn_wide_world(number)]
    for word in ("city", "--bad-drives", "--outages", "--bias-wander-m", "--jitter-px"):
        assert 5 < every.count(word) < 60, word
    width = [drawn[drawn.index("--width") + 1] for drawn in map(drawn_wide_world, range(100))]
    assert {*width} == {"640", "1280", "1920", "3840"}


def test_wide_worlds_are_mapped_where_they_are_asked_for(monkeypatch, capsys):
    monkeypatch.setattr(worlds, "main", written(FOUND))
    assert told(20, wide=True) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("  20 highway  pinhole 3840  5 Hz")


def test_a_good_map_is_a_line(monkeypatch, capsys):
    monkeypatch.setattr(worlds, "main", written(FOUND))
    assert told(13) == 0
    assert capsys.readouterr().out.splitlines()[1:] == [
        "  13 highway  fisheye 3840 30 Hz     8  100 % 100 %  0.050 m   88 %"
    ]


@pytest.mark.parametrize(
    "figures", [missing(0.5, 1.0), missing(0.0, None), missing(1.0, 0.7), None]
)
def test_of_a_map_that_lacks_signs_it_is_told_how_to_make_its_world(monkeypatch, capsys, figures):
    monkeypatch.setattr(worlds, "main", written(figures))
    assert told(13) == 1
    assert (
        capsys.readouterr()
        .out.splitlines()[-1]
        .startswith("     crowdmap simulate DATA --world highway")
    )


def test_a_world_without_signs_to_see_is_no_failure(monkeypatch):
    none = {"observable": 0, "recall": None, "precision": None, "relative": None}
    monkeypatch.setattr(worlds, "main", written({"signs": none, "uncertainty": None}))
    assert told(53) == 0
