"""The stages of the mapping pipeline, one module each."""
