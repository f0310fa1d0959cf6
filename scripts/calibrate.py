"""`crowdmap calibrate`, from a clone: the code is `crowdmap_torch/commands/calibrate.py`."""

import sys

from crowdmap_torch.cli import main

if __name__ == "__main__":
    sys.exit(main(["calibrate", *sys.argv[1:]]))
