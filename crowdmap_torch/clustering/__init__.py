"""Graph clustering, matching, votes and figures of groups of rows (V-A)."""
