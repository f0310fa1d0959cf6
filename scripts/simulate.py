"""`crowdmap simulate`, from a clone: the code is `crowdmap_torch/commands/simulate.py`."""

from crowdmap_torch.cli import program

if __name__ == "__main__":
    program("simulate")
