"""Subcommands that are modules, each with `add_arguments(parser)` and `run(options)`; only the chosen one is imported."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Mapping, Sequence
from typing import NoReturn

from crowdmap_torch.io.errors import one_line
from crowdmap_torch.processes.interrupts import loading


def add_subcommands(
    parser: argparse.ArgumentParser, package: str, summaries: Mapping[str, str]
) -> None:
    """Lets `parser` choose among modules of `package`: the options then hold `module`, and `prog`, its name in messages.

    A name with hyphens is a module with underscores.
    """
    chosen = parser.add_subparsers(
        metavar="NAME", required=True, parser_class=ModuleParser, title="subcommands"
    )
    for name, summary in summaries.items():
        own = chosen.add_parser(
            name, help=summary, description=f"{summary[0].upper()}{summary[1:]}."
        )
        own.module = f"{package}.{name.replace('-', '_')}"


class OneLineParser(argparse.ArgumentParser):
    """Says in one line what is wrong with a command line; `--help` shows how it is used."""

    def error(self, message: str) -> NoReturn:
        """Ends the program with exit code 2."""
        self.exit(2, f"{self.prog}: {one_line(message)}; see {self.prog} --help\n")


class ModuleParser(OneLineParser):
    """Asks its module for its options when it is chosen: what the others need would count as this one's memory."""

    module: str
    """Its full name."""

    def parse_known_args(self, args=None, namespace=None):  # pyright: ignore[reportIncompatibleMethodOverride]
        """The options, as the module declares them, and what is left."""
        try:
            with loading():
                module = importlib.import_module(self.module)
        except ModuleNotFoundError as missing:
            self.error(f"needs the Python package {missing.name!r}, which is not installed")
        module.add_arguments(self)
        self.set_defaults(module=module, prog=self.prog)
        given = sys.argv[1:] if args is None else args
        return super().parse_known_args(_negatives_joined(given), namespace)


def _negatives_joined(arguments: Sequence[str]) -> list[str]:
    """The same, with lists that begin below zero (`--bbox -50,0,50,90`) as values of the option before them."""
    joined: list[str] = []
    for argument in arguments:
        if joined and re.fullmatch(r"--[a-z-]+", joined[-1]) and re.match(r"-[\d.]+,", argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined
