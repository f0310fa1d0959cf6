"""`crowdmap evaluate`, from a clone: the code is `crowdmap_torch/commands/evaluate.py`."""

import sys

from crowdmap_torch.cli import main

if __name__ == "__main__":
    sys.exit(main(["evaluate", *sys.argv[1:]]))
