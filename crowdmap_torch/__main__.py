"""`python -m crowdmap_torch` is `crowdmap`."""

import sys

from crowdmap_torch.cli import main

if __name__ == "__main__":
    sys.exit(main())
