"""`crowdmap check`, from a clone: the code is `crowdmap_torch/commands/check.py`."""

from crowdmap_torch.cli import program

if __name__ == "__main__":
    program("check")
