"""Measures speed and accuracy side by side with other software: `benchmark.py NAME [options]`.

Each benchmark is a module of `crowdmap_torch.benchmark`; `benchmark.py NAME --help` tells its options.
"""

from __future__ import annotations

import sys

from crowdmap_torch.subcommands import run_chosen

BENCHMARKS = {
    "association": "landmarks told apart, ours against the paper's method",
    "bundle": "bundle adjustment, ours against Ceres and GTSAM",
    "cluster": "clustering at scale, ours against scikit-learn",
    "journey": "one drive: throughput and latency of a step",
    "ladybug": "bundle adjustment in the large, ours against Ceres",
}


def main(arguments: list[str] | None = None) -> int:
    """Reads the command line and runs one benchmark; 2 if the input is wrong."""
    description = (__doc__ or "").partition("\n")[0]
    return run_chosen(
        "benchmark.py", description, "crowdmap_torch.benchmark", BENCHMARKS, arguments
    )


if __name__ == "__main__":
    sys.exit(main())
