from __future__ import annotations

import argparse

import pytest

from crowdmap_torch.commands.subcommands import add_subcommands

BENCHMARKS = {"association": "who shows what", "bundle": "adjusted"}


@pytest.fixture
def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="crowdmap")
    add_subcommands(parser, "crowdmap_torch.benchmark", BENCHMARKS)
    return parser


def test_the_module_chosen_reads_the_options(parser: argparse.ArgumentParser):
    options = parser.parse_args(["bundle", "--threads", "3"])
    assert options.module.__name__ == "crowdmap_torch.benchmark.bundle"
    assert options.prog == "crowdmap bundle" and options.threads == 3


def test_subcommands_of_subcommands_have_their_full_name():
    parser = argparse.ArgumentParser(prog="crowdmap")
    add_subcommands(parser, "crowdmap_torch.commands", {"benchmark": "beside others"})
    options = parser.parse_args(["benchmark", "association", "DATA"])
    assert options.module.__name__ == "crowdmap_torch.benchmark.association"
    assert options.prog == "crowdmap benchmark association"


@pytest.mark.parametrize("given", [["--bbox", "-5,-1.5,8,9"], ["--bbox=-5,-1.5,8,9"]])
def test_a_list_that_begins_below_zero_is_the_value_of_its_option(given: list[str]):
    parser = argparse.ArgumentParser(prog="crowdmap")
    add_subcommands(parser, "crowdmap_torch.commands", {"optimize": "map"})
    options = parser.parse_args(["optimize", "DATA", "--out", "RUN", *given, "-q"])
    assert options.bbox.sides == (-5, -1.5, 8, 9) and options.quiet


def test_an_unknown_name_lists_the_known(
    parser: argparse.ArgumentParser, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as stop:
        parser.parse_args(["cooking"])
    assert stop.value.code == 2
    assert "association" in capsys.readouterr().err


def test_options_are_those_of_the_module(
    parser: argparse.ArgumentParser, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as stop:
        parser.parse_args(["association", "--help"])
    assert stop.value.code == 0
    assert "--methods" in capsys.readouterr().out
