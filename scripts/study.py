"""`crowdmap study`, from a clone: the code is `crowdmap_torch/commands/study.py`."""

import sys

from crowdmap_torch.cli import main

if __name__ == "__main__":
    sys.exit(main(["study", *sys.argv[1:]]))
