"""Reading and writing datasets, maps and run folders (FORMAT.md)."""
