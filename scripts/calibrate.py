"""`crowdmap calibrate`, from a clone: the code is `crowdmap_torch/commands/calibrate.py`."""

from crowdmap_torch.cli import program

if __name__ == "__main__":
    program("calibrate")
