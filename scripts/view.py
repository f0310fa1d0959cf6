"""`crowdmap view`, from a clone: the code is `crowdmap_torch/commands/view.py`."""

from crowdmap_torch.cli import program

if __name__ == "__main__":
    program("view")
