"""Batched nonlinear least squares over typed variables."""
