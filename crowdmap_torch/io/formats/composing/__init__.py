"""Data sets composed of what importers read: the parts, the conventions that they come in, and the formats there are."""
