"""What the mapper stands: the code is `crowdmap_torch/soak/soak.py`."""

import sys

from crowdmap_torch.soak.soak import main

if __name__ == "__main__":
    sys.exit(main())
