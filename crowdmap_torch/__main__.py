"""`python -m crowdmap_torch` is `crowdmap`."""

from crowdmap_torch.cli import program

if __name__ == "__main__":
    program()
