"""`crowdmap convert`, from a clone: the code is `crowdmap_torch/commands/convert.py`."""

import sys

from crowdmap_torch.cli import main

if __name__ == "__main__":
    sys.exit(main(["convert", *sys.argv[1:]]))
