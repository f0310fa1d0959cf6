"""`crowdmap export`, from a clone: the code is `crowdmap_torch/commands/export.py`."""

from crowdmap_torch.cli import program

if __name__ == "__main__":
    program("export")
