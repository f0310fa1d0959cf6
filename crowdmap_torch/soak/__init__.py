"""Data sets destroyed at random, and what the mapper makes of them; run by `python scripts/soak.py`."""
