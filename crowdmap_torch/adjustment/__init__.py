"""Bundle adjustment of everything at once (V-B)."""
