"""A survey beside a map: which sign of the one is which of the other, and the signs that pin a map."""
