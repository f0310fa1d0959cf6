"""Residuals of single observations, each readable beside its equation, and their Jacobians (V-B, eq:ba)."""
