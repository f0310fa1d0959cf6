"""The command line: `crowdmap NAME [options]`, or `python -m crowdmap_torch NAME [options]`.

Exit codes: 0 done; 2 the input or the configuration is wrong; 3 the map has no signs or no lanes though some were detected
(`optimize --strict`); 4 a dataset has what stops or spoils a map (`check`); 1 anything else, such as a disk that is full;
130, 143 and 129 ended by SIGINT, SIGTERM and SIGHUP; 141 done, but nobody read standard output to its end. Each but 0 and
141 is said in one line.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from crowdmap_torch import __version__
from crowdmap_torch.commands.subcommands import OneLineParser, add_subcommands
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.processes.interrupts import Interruptible, kept
from crowdmap_torch.processes.memory import arrow_in_one_place
from crowdmap_torch.processes.streams import StandardStreams

COMMANDS = {
    "optimize": "map a dataset",
    "simulate": "write a simulated dataset with exact ground truth",
    "check": "say everything that is wrong with a dataset, and put right what can be",
    "convert": "bring drives in other formats into a dataset",
    "evaluate": "compare a map with a survey",
    "export": "write a map in a format of others",
    "view": "write a page to walk around in a map, a run or a data set",
    "calibrate": "calibrate the road of a rig from surveyed points",
    "study": "draw the paper's figures, ours beside them",
    "benchmark": "measure speed and accuracy beside other software",
}


_OUTPUT_UNREAD = 128 + 13
"""As a shell sees a program that SIGPIPE ended."""


def program(*first: str) -> NoReturn:
    """Is the whole process: what follows `first` on its command line is read, and it ends with the exit code."""
    arrow_in_one_place()
    sys.exit(main([*first, *sys.argv[1:]], last=True))


def main(arguments: Sequence[str] | None = None, *, last: bool = False) -> int:
    """Reads the command line, runs the subcommand, and returns the exit code.

    `last`: the process ends with it; a signal that comes when all is done changes nothing any more.
    """
    options = argparse.Namespace(prog="crowdmap")

    def say(text: str) -> None:
        # Progress may have left its line open on a terminal.
        begin = "\r\x1b[K" if sys.stderr.isatty() else ""
        sys.stderr.write(f"{begin}{options.prog}: {text}\n")
        sys.stderr.flush()

    code = 0
    with (
        StandardStreams() as streams,
        Interruptible(lambda name: say(f"ended by {name}; {kept()}"), last=last) as signals,
    ):
        try:
            _parser().parse_args(arguments, options)
            code = options.module.run(options) or 0
        except InputError as error:
            say(str(error))
            code = 2
        except OSError as error:
            say(f"{_reason(error)}; {kept()}")
            code = 1
        except (MemoryError, RuntimeError) as error:
            if not _is_of_memory(error):
                raise
            say(f"not enough memory; {kept()}. {_SMALLER}")
            code = 1
        fault = streams.output_fault()
        if isinstance(fault, BrokenPipeError):
            code = code or _OUTPUT_UNREAD
        elif fault is not None:
            say(f"standard output: {_reason(fault)}")
            code = code or 1
    return 128 + signals.number if signals.number else code


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog="crowdmap", description="Many ordinary drives in, one map out.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    add_subcommands(parser, "crowdmap_torch.commands", COMMANDS)
    return parser


def _is_of_memory(error: Exception) -> bool:
    """Whether memory was asked for that is not there, by Python, by torch on the CPU or on a GPU."""
    told = str(error)
    return isinstance(error, MemoryError) or any(piece in told for piece in _OUT_OF_MEMORY)


_OUT_OF_MEMORY = ("can't allocate memory", "not enough memory", "out of memory")
_SMALLER = "Take a part of the drives (--journeys, --bbox), fewer --workers, or a larger machine"


def _reason(error: OSError) -> str:
    if error.strerror is None:
        return one_line(error)
    place = "" if error.filename is None else f"{error.filename}: "
    return one_line(f"{place}{error.strerror}")
