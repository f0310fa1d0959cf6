"""`crowdmap benchmark`, from a clone: the code is `crowdmap_torch/commands/benchmark.py`."""

import sys

from crowdmap_torch.cli import main

if __name__ == "__main__":
    sys.exit(main(["benchmark", *sys.argv[1:]]))
