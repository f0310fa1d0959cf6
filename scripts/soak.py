"""Destroys data sets at random and maps what is left: the code is `crowdmap_torch/soak/soak.py`."""

import sys

from crowdmap_torch.soak.soak import main

if __name__ == "__main__":
    sys.exit(main())
