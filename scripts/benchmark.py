"""Measures speed and accuracy side by side with other software: `benchmark.py NAME [options]`.

Each benchmark is a module of `crowdmap_torch.benchmark`; `benchmark.py NAME --help` tells its options.
"""

from __future__ import annotations

import argparse
import importlib
import sys

BENCHMARKS = {
    "association": "landmarks told apart, ours against the paper's method",
    "bundle": "bundle adjustment, ours against Ceres and GTSAM",
    "cluster": "clustering at scale, ours against scikit-learn",
    "journey": "one drive: throughput and latency of a step",
    "ladybug": "bundle adjustment in the large, ours against Ceres",
}


def main(arguments: list[str] | None = None) -> int:
    """Reads the command line and runs one benchmark; 2 if the input is wrong."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(
        prog="benchmark.py",
        description=__doc__.splitlines()[0] if __doc__ else None,
    )
    chosen = parser.add_subparsers(dest="name", metavar="NAME", required=True)
    for name, summary in BENCHMARKS.items():
        own = chosen.add_parser(name, help=summary, description=summary)
        # The others are not imported: what they need would count as this one's memory.
        if name in arguments[:1]:
            importlib.import_module(f"crowdmap_torch.benchmark.{name}").add_arguments(own)
    options = parser.parse_args(arguments)
    try:
        importlib.import_module(f"crowdmap_torch.benchmark.{options.name}").run(options)
    except ValueError as error:
        print(f"benchmark.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
