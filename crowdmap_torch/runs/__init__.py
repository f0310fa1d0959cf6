"""What a run writes: its folder, with everything that FORMAT.md names, and metrics.json."""
