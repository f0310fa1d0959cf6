"""`crowdmap simulate`, from a clone: the code is `crowdmap_torch/commands/simulate.py`."""

import sys

from crowdmap_torch.cli import main

if __name__ == "__main__":
    sys.exit(main(["simulate", *sys.argv[1:]]))
