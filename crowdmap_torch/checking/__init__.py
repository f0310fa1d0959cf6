"""A data set checked as a whole: everything that FORMAT.md and physics say of it, and what can be put right."""
