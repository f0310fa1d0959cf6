"""`crowdmap optimize`, from a clone: the code is `crowdmap_torch/commands/optimize.py`."""

import sys

from crowdmap_torch.cli import main

if __name__ == "__main__":
    sys.exit(main(["optimize", *sys.argv[1:]]))
