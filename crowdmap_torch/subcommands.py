"""A script made of modules: `SCRIPT NAME [options]`, each NAME a module with `add_arguments` and `run`."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Mapping, Sequence


def run_chosen(
    script: str,
    description: str,
    package: str,
    summaries: Mapping[str, str],
    arguments: Sequence[str] | None = None,
) -> int:
    """Runs the module of `package` that the command line names; 2, and one line on stderr, if the input is wrong.

    A name with hyphens is a module with underscores.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    parser = argparse.ArgumentParser(prog=script, description=description)
    chosen = parser.add_subparsers(dest="name", metavar="NAME", required=True)
    for name, summary in summaries.items():
        own = chosen.add_parser(name, help=summary, description=summary)
        # The others are not imported: what they need would count as this one's memory.
        if name in arguments[:1]:
            _module(package, name).add_arguments(own)
    options = parser.parse_args(arguments)
    try:
        _module(package, options.name).run(options)
    except ValueError as error:
        sys.stderr.write(f"{script}: {error}\n")
        return 2
    return 0


def _module(package: str, name: str):
    return importlib.import_module(f"{package}.{name.replace('-', '_')}")
