"""The command line: `crowdmap NAME [options]`, or `python -m crowdmap_torch NAME [options]`.

Exit codes: 0 done; 2 the input or the configuration is wrong, said in one line; 1 anything else.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from crowdmap_torch import __version__
from crowdmap_torch.commands.subcommands import add_subcommands
from crowdmap_torch.io.errors import InputError

COMMANDS = {
    "optimize": "map a dataset",
    "simulate": "write a simulated dataset with exact ground truth",
    "evaluate": "compare a map with a survey",
    "calibrate": "calibrate the road of a rig from surveyed points",
    "study": "draw the paper's figures, ours beside them",
    "benchmark": "measure speed and accuracy beside other software",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Reads the command line, runs the subcommand, and returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="crowdmap", description="Many ordinary drives in, one map out."
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    add_subcommands(parser, "crowdmap_torch.commands", COMMANDS)
    options = parser.parse_args(arguments)
    try:
        options.module.run(options)
    except InputError as error:
        sys.stderr.write(f"{options.prog}: {error}\n")
        return 2
    return 0
